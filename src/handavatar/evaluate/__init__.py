"""Metrics and protocols that judge an avatar, and the report that shows them."""
