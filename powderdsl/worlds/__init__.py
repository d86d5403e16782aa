"""Start worlds from shapes, scenes, drawings and pictures; saved worlds."""
