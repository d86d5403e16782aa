"""Declarations of several packs -> one composition: names, ids, orders, and who speaks of what."""
