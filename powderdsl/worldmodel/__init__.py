"""World models: networks that learn to predict a world some steps on (Frans & Isola 2023, section 4).

`pairs` makes the data, `replay` keeps it, `unet` is the paper's network, `training` and `scores` take that one or any
other: a callable from ids uint8 [B, H, W] to logits [B, slots, H, W].
"""
