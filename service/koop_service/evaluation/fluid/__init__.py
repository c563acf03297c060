"""`koop-eval fluid`: the flow past a cylinder (section A.3 of the paper), on unseen flows."""
