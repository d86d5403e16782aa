"""Checking invariants: by proofs if possible, else on random worlds, with counterexamples made small."""
