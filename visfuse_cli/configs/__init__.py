"""Commented default configurations, one a use, read as package resources."""
