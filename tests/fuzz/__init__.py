"""Fuzzing: targets compared on random rules, damaged rule files, failing cases made small."""
