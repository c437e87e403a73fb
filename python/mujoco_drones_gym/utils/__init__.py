"""Enums and logs."""
