"""Our random numbers as numbers: fair bits, unrelated to whatever else the hash was given."""

from __future__ import annotations


def test_draws_are_uniform_and_unrelated(torch) -> None:  # type: ignore[no-untyped-def]
    """Bit planes of our randomness: fair, and uncorrelated with neighbours, steps, streams, seeds and worlds."""
    from powderdsl.backends import torch_random

    idents = torch.tensor([0x05562E58, 0x116B05CF])

    def bits(seed: int, index: int, step: int, stream: int):  # type: ignore[no-untyped-def]
        base = torch_random.base_keys(torch.tensor([seed]), torch.tensor([index]))
        keys = torch_random.step_keys(base, torch.tensor([step]), idents)
        draws = torch_random.draws(keys[stream], 16, 256, 256)[0]
        return torch.stack([(draws >> j) & 1 for j in range(16)]).double() * 2 - 1

    first = bits(1, 0, 0, 0)
    count = first[0].numel()
    bound = 5.5 / count**0.5  # five and a half deviations: a false alarm in about 10^-7 of comparisons
    others = [bits(1, 0, 1, 0), bits(1, 0, 0, 1), bits(1, 1, 0, 0), bits(2, 0, 0, 0)]
    assert first.mean((1, 2)).abs().max() < bound
    for other in others:
        assert (first * other).mean((1, 2)).abs().max() < bound
        assert not torch.equal(first, other)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (0, 32), (0, 64)):
        assert (first * torch.roll(first, (dy, dx), (1, 2))).mean((1, 2)).abs().max() < bound
    between = torch.einsum("aij,bij->ab", first, first) / count
    assert (between - torch.eye(16)).abs().max() < bound
