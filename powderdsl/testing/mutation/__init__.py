"""Mutation testing of packs: realistic mistakes, what notices them, and worlds that show those that nothing notices."""
