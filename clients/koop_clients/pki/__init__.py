"""Certificates and access rules: who may say and hear what through a koop hub."""
