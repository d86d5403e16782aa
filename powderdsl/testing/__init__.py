"""For testing rules and backends: random rulesets and worlds, comparison of backends, reduction of failing cases.

Only `strategies` needs Hypothesis.
"""
