"""Static analysis: facts about rules that need no run."""
