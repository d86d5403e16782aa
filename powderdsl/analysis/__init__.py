"""Static analysis: facts about rules, found without running them."""
