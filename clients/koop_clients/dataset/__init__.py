"""`koop-dataset`: simulate and draw training sets with the code that streams."""
