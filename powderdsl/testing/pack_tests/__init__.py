"""Tests in packs."""
