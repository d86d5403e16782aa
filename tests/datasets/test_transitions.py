"""Transitions by number reach each reader exactly once, in any number of processes; splits share no world."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, IterableDataset

from powderdsl.datasets import Dataset, Transitions, record, split
from powderdsl.datasets.dataset import Batch
from powderdsl.datasets.manifest import FILE, read_manifest, write_manifest
from powderdsl.diagnostics import CompileError
from powderdsl.tasks.episodes import TaskProgram
from tests.datasets.test_reading import numbered, windows_of
from tests.refusals import refusal

LENGTHS = [3, 1, 7, 2, 5, 5, 1, 4, 6, 2, 3]
TRANSITIONS = [(e, t) for e, length in enumerate(LENGTHS) for t in range(length)]

# Python 3.12 and later warn of a fork beside other threads, torch of more workers than cores.
pytestmark = [
    pytest.mark.filterwarnings("ignore:This process:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning"),
]

PROCESSES = [(0, None), (2, "fork")]


@pytest.fixture(params=[False, True], ids=["mapped", "compressed"])
def counted(request: pytest.FixtureRequest, recorded: Dataset, tmp_path: Path) -> Dataset:
    """Episodes of several lengths, whose observations are (episode, number of the observation)."""
    return numbered(tmp_path, recorded.recipe, LENGTHS, 4, compress=request.param)


def loader(data: Any, processes: tuple[int, str | None], **options: Any) -> DataLoader[Any]:
    workers, context = processes
    return DataLoader(data, num_workers=workers, multiprocessing_context=context, **options)


def names(batch: Batch) -> list[tuple[int, int]]:
    """The (episode, action) of each transition of a batch, whose parts must belong together."""
    return windows_of(Batch(*(value[:, None] for value in batch)), LENGTHS)


# By number


@pytest.mark.parametrize("processes", PROCESSES)
@pytest.mark.parametrize("shuffle", [False, True])
def test_a_loader_yields_each_transition_once(
    counted: Dataset, processes: tuple[int, str | None], shuffle: bool
) -> None:
    rows = pickle.loads(pickle.dumps(Transitions(counted)))
    found = [
        name for batch in loader(rows, processes, batch_size=4, shuffle=shuffle) for name in names(batch)
    ]
    assert sorted(found) == TRANSITIONS
    assert (found == TRANSITIONS) is not shuffle


def test_numbers_are_those_of_a_sequence(counted: Dataset) -> None:
    rows = Transitions(counted)
    assert len(rows) == counted.steps == len(TRANSITIONS)
    one = rows[5]
    assert one.observation.shape == (1, 1, 2)
    assert names(Batch(*(value[None] for value in one))) == [TRANSITIONS[5]]
    assert names(rows[-3:]) == TRANSITIONS[-3:]
    for numbers in ([7, 0, -1, 7], np.array([7, 0, -1, 7]), torch.tensor([7, 0, -1, 7])):
        assert names(rows[numbers]) == [TRANSITIONS[i] for i in (7, 0, -1, 7)]
    assert torch.equal(rows[np.int64(2)].reward, rows[torch.tensor(2)].reward)
    assert rows[[]].reward.shape == (0,)
    for wrong in (len(rows), -len(rows) - 1, [0, len(rows)]):
        with pytest.raises(IndexError, match=f"there are {len(rows)}"):
            rows[wrong]
    for odd in (1.0, "1", [0.5], [True, False], None):
        with pytest.raises(TypeError):
            rows[odd]


def test_sequences_by_number_are_all_windows(counted: Dataset) -> None:
    rows = Transitions(counted, length=3)
    wanted = [(e, t) for e, length in enumerate(LENGTHS) for t in range(length - 2)]
    (batch,) = DataLoader(rows, batch_size=len(rows))
    assert batch.observation.shape == (len(wanted), 3, 1, 1, 2)
    assert windows_of(batch, LENGTHS) == wanted
    assert rows[0].reward.shape == (3,)
    with pytest.raises(ValueError, match="length must be an integer from 1 to 7"):
        Transitions(counted, length=8)


def test_several_folders_follow_one_another(recorded: Dataset, tmp_path: Path) -> None:
    parts, wanted = [], []
    for name, lengths in (("a", [2, 3]), ("b", [4]), ("c", [1, 2, 2])):
        (tmp_path / name).mkdir()
        parts.append(numbered(tmp_path / name, recorded.recipe, lengths, 2, compress=False))
        wanted += [[e, t] for e, length in enumerate(lengths) for t in range(length)]
    rows = Transitions(parts)
    assert len(rows) == len(wanted)
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0)).tolist()
    assert rows[order].observation[:, 0, 0].tolist() == [wanted[i] for i in order]


def test_folders_of_other_meaning_are_refused(recorded: Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    other = numbered(folder, replace(recorded.recipe, choices=("blow", "x")), [1], 1, compress=False)
    (found,) = refusal(Transitions, [recorded, other])
    assert found.code == "PD631"
    assert any(note.startswith("`choices`") for note in found.notes)
    with pytest.raises(ValueError, match="at least one"):
        Transitions([])


def test_lengths_that_do_not_fit_are_found_before_reading(counted: Dataset) -> None:
    manifest = read_manifest(counted.folder)
    first, *rest = manifest.shards
    longer = replace(first, transitions=first.transitions + 1)
    write_manifest(counted.folder, replace(manifest, shards=(longer, *rest)))
    with pytest.raises(CompileError, match="PD630"):
        Transitions(Dataset.open(counted.folder))
    assert (counted.folder / FILE).exists()


# Endless minibatches


class Wrapped(IterableDataset[Batch]):
    """What users write around the iterator."""

    def __init__(self, data: Dataset):
        self.data = data

    def __iter__(self) -> Any:
        return iter(self.data.transitions(8, seed=4, start=3))


@pytest.mark.parametrize("processes", PROCESSES)
@pytest.mark.parametrize("wrapped", [False, True])
def test_workers_share_the_minibatches(
    recorded: Dataset, processes: tuple[int, str | None], wrapped: bool
) -> None:
    """The same ones in the same order as without workers. They yielded each minibatch once a worker before."""
    data = Wrapped(recorded) if wrapped else recorded.transitions(8, seed=4, start=3)
    wanted = islice(recorded.transitions(8, seed=4, start=3), 7)
    for found, one in zip(islice(loader(data, processes, batch_size=None), 7), wanted, strict=True):
        assert isinstance(found, Batch)
        assert all(torch.equal(a, b) for a, b in zip(found, one, strict=True))


# Splits


def episodes_of(rows: Transitions) -> set[tuple[int, int]]:
    return set(zip(rows.episodes.source.tolist(), rows.episodes.number.tolist(), strict=True))


@pytest.fixture(scope="module")
def replayed(small: TaskProgram, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """40 episodes of the 16 worlds 0 … 15."""
    folder = tmp_path_factory.mktemp("data") / "replayed"
    return record(small, "random", folder, episodes=40, worlds=16, seed=5, envs=8)


def test_no_world_is_in_two_parts(replayed: Dataset, recorded: Dataset) -> None:
    rows = Transitions([replayed, recorded])
    parts = split(rows, (0.5, 0.25, 0.25))
    worlds = [set(part.worlds.tolist()) for part in parts]
    assert sum(map(len, worlds)) == len(set.union(*worlds))
    assert set.union(*worlds) == set(rows.worlds.tolist())
    assert sum(len(part) for part in parts) == len(rows)
    assert set.union(*map(episodes_of, parts)) == episodes_of(rows)
    for part, one in zip(parts, worlds, strict=True):
        for source, number in episodes_of(part):
            assert rows.datasets[source].episode(number).world in one
        read = torch.cat([batch.reward for batch in DataLoader(part, batch_size=16)])
        assert torch.equal(read, part[:].reward)


def test_a_split_depends_on_the_world_or_episode_and_the_seed_alone(
    replayed: Dataset, recorded: Dataset
) -> None:
    alone = split(Transitions(replayed), (0.6, 0.4))
    torch.manual_seed(99)
    np.random.seed(99)
    beside = split(Transitions([recorded, replayed]), (0.6, 0.4))
    for one, other in zip(alone, beside, strict=True):
        assert {number for source, number in episodes_of(other) if source == 1} == {
            number for _, number in episodes_of(one)
        }
    again = split(pickle.loads(pickle.dumps(Transitions(replayed))), (0.6, 0.4))
    assert [episodes_of(one) for one in again] == [episodes_of(one) for one in alone]
    other_seed = split(Transitions(replayed), (0.6, 0.4), seed=1)
    assert [episodes_of(one) for one in other_seed] != [episodes_of(one) for one in alone]
    for seed in (-1, 1 << 62):
        with pytest.raises(ValueError, match="seed"):
            split(Transitions(replayed), (0.6, 0.4), seed=seed)

    rows = Transitions(replayed)
    parts = split(rows, (0.5, 0.5), by="episode")  # which keeps episodes whole
    numbers = [episodes_of(part) for part in parts]
    assert not numbers[0] & numbers[1]
    assert numbers[0] | numbers[1] == episodes_of(rows)
    assert set(parts[0].worlds.tolist()) & set(parts[1].worlds.tolist()), "worlds are played several times"


def test_parts_have_about_their_fractions(recorded: Dataset, tmp_path: Path) -> None:
    rows = Transitions(numbered(tmp_path, recorded.recipe, [1] * 4000, 4000, compress=False))
    for by in ("world", "episode"):
        sizes = [len(part) for part in split(rows, (0.7, 0.2, 0.1), by=by, seed=1 << 40)]
        assert sum(sizes) == 4000
        assert abs(np.array(sizes) - [2800, 800, 400]).max() < 150


def test_invalid_splits_are_refused(recorded: Dataset) -> None:
    rows = Transitions(recorded)
    for fractions in ((), (0.5, 0.4), (1.5, -0.5), (1, 0)):
        with pytest.raises(ValueError, match="positive and sum to 1"):
            split(rows, fractions)
    with pytest.raises(ValueError, match="world, episode"):
        split(rows, (0.5, 0.5), by="transition")
    with pytest.raises(ValueError, match="part 1 would be empty"):
        split(rows, (0.999999, 0.000001))
