"""Scene files: start worlds drawn in one-line statements, later ones over earlier ones.

    scene: NAME
    about: What it shows, in a sentence.
    size: [64, 64]                                     # rows, columns
    fill: ELEMENT
    draw:
      - line ELEMENT from (63, 5) to (32, 5) width 3   # points are (row, column)
      - disk ELEMENT at (32, 32) radius 10
      - box ELEMENT rows 32:64                         # a:b leaves b out; all columns unless it says so
      - box ELEMENT rows 48:end columns :16            # `48:` means the same, but YAML takes it for a key
      - frame ELEMENT
      - FIELD := VALUE in box rows 32:64               # everywhere without `in SHAPE`

`draw` may also be a `|` block, one statement a line. A file with several scenes has a list under `scenes`.
"""

from powderdsl.worlds.scene.read import Start, draw_start, find_scene, shipped_scenes

__all__ = ["Start", "draw_start", "find_scene", "shipped_scenes"]
