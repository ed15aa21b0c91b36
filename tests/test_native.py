"""The two forms of a structure's machine code: the same bits, before and after the code is joined, in every thread."""

from __future__ import annotations

import gc
import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pytest

from servolens.effects import CATALOGUE, Cogging, CoulombFriction, StribeckFriction
from servolens.errors import ServolensError
from servolens.plant import Plant
from servolens.record import Controller
from servolens.simulation import simulate_continuous, simulate_loop
from servolens.simulation.native import WORK_THAT_PAYS, native
from servolens.simulation.trial import observed_trial

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from servolens.simulation import Simulation

Answer = TypeVar("Answer")

TIME = 1e-3 * np.arange(501)
LOOP = Controller(kp=60.0, kd=2.0)
REFERENCE = np.where(TIME < 0.25, 0.1, -0.03)
PAIRS = (
    ("actuator_lag", "cogging"),
    ("asymmetric_damping", "backlash"),
    ("backlash", "presliding"),
    ("coulomb_friction", "flexible_coupling"),
    ("presliding", "sensor_lag"),
    ("speed_servo", "stribeck_friction"),
)
COMBINATIONS = {"none": (), **{name: (name,) for name in CATALOGUE}, **{" and ".join(pair): pair for pair in PAIRS}}
CONTINUOUS = ("none", "presliding", "asymmetric_damping and backlash")
STICKY = Plant(gain=1.9, damping=6.0, effects=(CoulombFriction(level=0.2), Cogging(amplitude=0.2, pitch=0.02, phase=0)))


def plant_of(combination: str) -> Plant:
    effects = [CATALOGUE[name](**CATALOGUE[name].typical) for name in COMBINATIONS[combination]]
    return Plant(gain=1.9, damping=6.0, effects=tuple(effects))


def bits(simulate: Callable[[], Simulation]) -> bytes:
    """Return all that a simulation gives, or what it is refused with."""
    try:
        run = simulate()
    except ServolensError as error:
        return str(error).encode()
    return np.concatenate([run.position, run.velocity, run.voltage, run.measured]).tobytes()


def outcomes(combination: str) -> dict[str, bytes]:
    """Return what the loop, an observer and, of a few, the continuous loop give, bit by bit."""
    plant, random = plant_of(combination), np.random.default_rng(0)
    gains = np.abs(random.normal(size=(TIME.size, 3))) * [0.05, 1.0, 5.0]
    position = 0.05 * np.sin(9.0 * TIME) + 1e-4 * random.normal(size=TIME.size)
    voltage = 4.0 * np.cos(9.0 * TIME)
    observed = observed_trial(TIME, voltage, position, gains=gains, remembered=0.9)
    runs = {
        "loop": lambda: simulate_loop(plant, LOOP, TIME, REFERENCE),
        "observer": lambda: observed.simulated(plant, (0.0, 0.0), 2),
    }
    if combination in CONTINUOUS:
        runs["continuous"] = lambda: simulate_continuous(plant, LOOP.kp, LOOP.kd, TIME, REFERENCE)
    return {name: bits(run) for name, run in runs.items()}


def is_joined(structure: tuple[type, ...], work: int = 0) -> bool:
    return native(structure, work=work).is_joined


def slopes(function: Callable[..., int]) -> list[float]:
    """Return the Jacobian of a sticky plant in motion."""
    x, p, found = np.array([0.1, 0.2, 0.0, 0.0, 1.0, 1.0, 0.0]), np.array(STICKY.values), np.empty(4)
    function(x.ctypes.data, p.ctypes.data, found.ctypes.data)
    return found.tolist()


def kept_functions() -> tuple[list[float], list[float], bool]:
    """Take a function of separate code, let joined code replace it, and call it."""
    function = native(STICKY.structure).slopes
    before = slopes(function)
    replaced = is_joined(STICKY.structure, WORK_THAT_PAYS)
    gc.collect()
    return before, slopes(function), replaced


def both_forms(combination: str) -> tuple[list[bool], list[dict[str, bytes]]]:
    """Simulate, ask for so much that the code is joined, and simulate again."""
    structure = plant_of(combination).structure
    found, joined = [outcomes(combination)], [is_joined(structure)]
    joined.append(is_joined(structure, WORK_THAT_PAYS))
    if combination in CONTINUOUS:
        native(structure, continuous=True, work=WORK_THAT_PAYS)
    found.append(outcomes(combination))
    return joined, found


def all_forms() -> dict[str, tuple[list[bool], list[dict[str, bytes]]]]:
    return {combination: both_forms(combination) for combination in COMBINATIONS}


def crowd() -> tuple[set[bytes], bool, bool]:
    """Simulate in threads that begin at once, of which one makes the code hot."""

    def many(number: int) -> list[bytes]:
        return [one(work=WORK_THAT_PAYS if number == 1 and turn == 5 else 0) for turn in range(20)]

    def one(work: int) -> bytes:
        native(STICKY.structure, work=work)
        return bits(lambda: simulate_loop(STICKY, LOOP, TIME, REFERENCE))

    with ThreadPoolExecutor(4) as pool:
        answers = {answer for answers in pool.map(many, range(4)) for answer in answers}
    hot_by_work = [is_joined((StribeckFriction,), WORK_THAT_PAYS // 3 + 1) for _ in range(3)]
    return answers, is_joined(STICKY.structure), hot_by_work == [False, False, True]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kernels")


def in_new_process(function: Callable[..., Answer], folder: Path, *given: object) -> Answer:
    """Call a function in a process that has compiled nothing yet, with its own cache folder."""
    with pytest.MonkeyPatch.context() as patch, ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        patch.setenv("SERVOLENS_CACHE", str(folder))
        return pool.submit(function, *given).result()


@pytest.fixture(scope="module")
def forms(folder: Path) -> dict[str, tuple[list[bool], list[dict[str, bytes]]]]:
    """From a process that finds nothing on disk."""
    return in_new_process(all_forms, folder)


@pytest.mark.parametrize("combination", COMBINATIONS)
def test_separate_and_joined_code_give_the_same_bits(forms, combination: str) -> None:
    joined, (separate, together) = forms[combination]
    assert joined == [False, True]
    assert all(len(found) == 4 * 8 * TIME.size for found in separate.values())
    assert len(set(separate.values())) == len(separate)
    assert separate == together


def test_joined_code_on_disk_is_used_at_once_and_gives_the_same_bits(forms, folder: Path) -> None:
    combination = "presliding"
    joined, found = in_new_process(both_forms, folder, combination)
    assert joined == [True, True]
    assert found == forms[combination][1]


def test_damaged_code_on_disk_is_made_anew_and_gives_the_same_bits(forms, folder: Path, tmp_path: Path) -> None:
    """But for the rule's text, which takes long and is read as the others are."""
    combination, damaged = "presliding", 0
    for path in folder.iterdir():
        whole, is_text = path.read_bytes(), path.name.startswith("stepping-")
        (tmp_path / path.name).write_bytes(whole if is_text else whole[:40])
        damaged += not is_text
    assert damaged >= 4
    joined, found = in_new_process(both_forms, tmp_path, combination)
    assert joined == [False, True]
    assert found == forms[combination][1]


@pytest.fixture
def no_plant(forms, folder: Path, tmp_path: Path) -> Path:
    """Return a folder with the rule's text and object only."""
    for path in folder.iterdir():
        if path.name.startswith(("stepping-", "elementary-", "rule-")):
            shutil.copy(path, tmp_path)
    return tmp_path


def test_threads_get_the_same_bits_while_code_is_joined(no_plant: Path) -> None:
    answers, is_joined_now, is_sum_that_counts = in_new_process(crowd, no_plant)
    assert len(answers) == 1
    assert is_joined_now
    assert is_sum_that_counts


def test_a_function_of_replaced_code_stays_alive(no_plant: Path) -> None:
    before, after, is_replaced = in_new_process(kept_functions, no_plant)
    assert is_replaced
    assert before == after
