"""Certificates, result rows, statistics and tables."""
