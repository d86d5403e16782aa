"""Proofs about rules, for all worlds, and a SAT solver."""
