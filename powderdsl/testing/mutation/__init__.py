"""Mutation testing of packs: realistic mistakes, the checks that detect them, and worlds that expose survivors."""
