"""The tests that packs bring along."""
