"""Mutation testing of packs: realistic mistakes, the checks that notice them, and worlds that show the survivors."""
