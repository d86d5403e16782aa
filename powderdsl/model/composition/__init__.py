"""Declarations of several packs -> one composition: names, ids, orders, and the scopes of claims."""
