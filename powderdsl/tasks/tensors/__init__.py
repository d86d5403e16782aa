"""Tasks on tensors: generators, shapes, actions, measures."""
