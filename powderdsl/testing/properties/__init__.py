"""Invariants held against rules: proven where that is possible, else tested on worlds, broken ones made small."""
