"""Random rulesets and start worlds, from a seed or from Hypothesis."""
