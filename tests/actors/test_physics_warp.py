"""Warp on a CPU: a mesh for each environment, resets, other objects, compiled loops, agreement with
native.
"""

import dataclasses
import os
import pathlib
import subprocess
import sys
import threading
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from congrasp.actors.physics import slots
from congrasp.actors.physics.engine import ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.physics.object_rows import ObjectRows
from congrasp.actors.physics.scene import compile_scene, scene_spec
from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.transport.ports import free_port
from tests.actors.test_physics import (
    HAND,
    TASK,
    above,
    agreeing,
    grasp,
    one_each,
    servoed,
    side_by_side,
)
from tests.compiled import program_count
from tests.conftest import ROOT
from tests.solids import mujoco_mass_properties
from tests.task import warp_engine

OBJECTS = [
    procedural.generate(i, family) for i, family in enumerate(["box", "bowl", "mug", "ring"])
]
OTHERS = [
    procedural.generate(i, family)
    for i, family in enumerate(["ring", "cylinder", "bowl", "bowl", "box"], 7)
]


def _starts(objects: Sequence[GraspObject]) -> ResetState:
    return jax.tree.map(jnp.asarray, above(one_each(objects), 0.19))


@pytest.fixture(scope="module")
def start():
    return _starts(OBJECTS)


@pytest.fixture(scope="module")
def others():
    return _starts(OTHERS)


def _same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def _picked(start: ResetState, index: list[int]) -> ResetState:
    return ResetState(*(leaf[np.array(index)] for leaf in start))


def _agrees_with_native(
    native: NativePhysics, objects: Sequence[GraspObject], start: ResetState
) -> None:
    warp = warp_engine(objects)
    for i, x, y, _ in agreeing(native, jax.jit(warp.step), start, warp.start(start)):
        if i == 20:
            np.testing.assert_allclose(x.contact_force, y.contact_force, atol=0.5)
            np.testing.assert_allclose(x.object_position, y.object_position, atol=1e-3)
    np.testing.assert_allclose(x.q, y.q, atol=0.25)
    warp.close()


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_primitives_and_meshes_of_one_pool_agree_with_native(native, start):
    _agrees_with_native(native(OBJECTS), OBJECTS, start)


def test_gains_of_each_environment_agree_with_native(native):
    start, target = servoed(one_each(OBJECTS))
    warp = warp_engine(OBJECTS)
    state = warp.start(jax.tree.map(jnp.asarray, start))
    *_, (x, y, _) = side_by_side(native(OBJECTS), jax.jit(warp.step), start, state, [target] * 5)
    np.testing.assert_allclose(x.q, y.q, atol=2e-4)
    away = np.abs(target[:, 6:] - np.asarray(x.q)).mean(1)
    assert (np.diff(away) < -1e-3).all(), "stronger servos come nearer"
    warp.close()


def _scanned(folder: pathlib.Path) -> GraspObject:
    """The convex pieces of a scanned object, as if it had been imported with all their vertices."""
    hulls = [
        trimesh.load(file).convex_hull.vertices for file in sorted(folder.glob("contact*.stl"))
    ]
    pieces = [Piece("mesh", (0.0, 0.0, 0.0), vertices=vertices) for vertices in hulls]
    mass, center, inertia = mujoco_mass_properties(pieces, [500.0] * len(pieces))
    pieces = [dataclasses.replace(piece, pos=tuple(-center)) for piece in pieces]
    low = min(vertices[:, 2].min() for vertices in hulls) - center[2]
    rest = np.array([[0.0, 0.0, -low, 1.0, 0.0, 0.0, 0.0]])
    return dataclasses.replace(
        OBJECTS[1],
        name=folder.name,
        pieces=tuple(pieces),
        mass=mass,
        inertia=inertia,
        rest_poses=rest,
    )


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_scanned_objects_agree_with_native(native, shared_objects):
    objects = [_scanned(shared_objects / name) for name in ("camera", "flashlight", "hammer")]
    assert max(len(obj.pieces) for obj in objects) > 1
    _agrees_with_native(native(objects), objects, _starts(objects))


def test_repeated_steps_without_jax_equal_control_steps(start):
    """One control step by JAX and three repeats are four control steps with the same targets; and
    nobody notices.
    """
    physics = warp_engine(OBJECTS)
    batch = len(OBJECTS)
    target = jnp.asarray(grasp(start, 5))
    table = jnp.ones(batch, bool)
    step = jax.jit(physics.step)
    first, _ = step(physics.start(start), target, table)
    before = jax.tree.map(np.array, first)
    physics.repeat(batch, 3)
    repeated = physics.buffers(batch).positions()
    _same(before, first)
    after = first
    for _ in range(3):
        after, _ = step(after, target, table)
    np.testing.assert_allclose(repeated, after.qpos, atol=1e-5)
    assert np.abs(repeated - before.qpos).max() > 1e-3
    physics.close()


def test_a_control_step_loads_no_further_kernel(start, monkeypatch):
    """Of those that MuJoCo Warp launches; JAX's call is a module without kernels."""
    import warp as wp  # takes seconds in every worker

    physics = warp_engine(OBJECTS)
    loaded = set()
    load = wp._src.context.Module.load

    def noted(module, device, block_dim=None, **options):
        loaded.add((module.name, block_dim))
        return load(module, device, block_dim, **options)

    monkeypatch.setattr(wp._src.context.Module, "load", noted)
    state = physics.start(start)
    physics.buffers(len(OBJECTS)).wait_for_kernels()
    ahead = set(loaded)
    physics.step(state, jnp.asarray(grasp(start, 5)), jnp.ones(len(OBJECTS), bool))
    assert len(ahead) > 40
    assert loaded - ahead == {("congrasp.actors.physics.warp", 1)}
    physics.close()


def test_only_broadphase_kernels_depend_on_the_batch(
    monkeypatch,
):
    import warp as wp  # takes seconds in every worker

    from congrasp.actors.physics import warp_buffers

    monkeypatch.setattr(warp_buffers, "build_kernels", lambda device, variants: None)
    monkeypatch.setattr(
        wp, "get_suggested_block_size", lambda *query: pytest.fail("this would build a kernel")
    )
    monkeypatch.setattr(
        wp._src.context.Module, "load", lambda *module: pytest.fail("this builds a module")
    )

    def modules(engine, batch):
        return [module.name for module, _ in engine.allocate(batch).variants()]

    few = modules(warp_engine(OBJECTS), 1)
    many = modules(warp_engine(OBJECTS[:1], mesh_slots=9), 2)
    assert len(many) > 40, "the first are those that are queried"
    assert many[0].startswith("_nxn_broadphase"), "the first are those that are queried"
    assert all(name.startswith("_nxn_broadphase") for name in {*few} ^ {*many})


def test_processes_do_not_build_the_same_kernels_at_the_same_time(tmp_path, monkeypatch):
    import warp as wp  # takes seconds in every worker

    from congrasp.actors.physics import warp_build
    from congrasp.actors.physics.warp_build import one_builder

    program = (
        "import fcntl, sys; f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX); "
        "print(flush=True); input()"
    )
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    entered = threading.Event()

    def build():
        with one_builder([]):
            entered.set()

    build()
    entered.clear()
    (lock,) = tmp_path.iterdir()
    with subprocess.Popen(
        [sys.executable, "-c", program, str(lock)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        thread = threading.Thread(target=build)
        thread.start()
        assert not entered.wait(0.5)
        other.kill()
        thread.join(30.0)
    assert entered.is_set()
    with subprocess.Popen(
        [sys.executable, "-c", program, str(lock)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        monkeypatch.setattr(warp_build, "PATIENCE_S", 0.1)
        build()  # after a wait it builds, too
        other.kill()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "missing"))
    with one_builder([]):
        pass  # without a folder nothing is shared


def test_object_rows_equal_mujocos_compiled_fields():
    catalogue = ObjectRows(HAND, TASK, OBJECTS[0], 8)
    before = {
        name: getattr(catalogue.model, name).copy()
        for name in ("geom_dataid", "geom_size", "body_mass")
    }
    rows, meshes = catalogue.rows(OBJECTS)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(catalogue.model, name), value)
    for n, obj in enumerate(OBJECTS):
        scene = compile_scene(HAND, TASK, obj)
        body = scene.body("object").id
        np.testing.assert_allclose(rows["body_mass"][n], obj.mass)
        np.testing.assert_allclose(rows["body_subtreemass"][n], scene.body_subtreemass[[0, body]])
        np.testing.assert_allclose(
            rows["body_invweight0"][n], scene.body_invweight0[body], rtol=1e-4
        )
        for name in ("body_invweight0", "dof_invweight0"):
            hand = slice(0, scene.nv - 6) if name.startswith("dof") else slice(0, body)
            np.testing.assert_allclose(
                getattr(catalogue.model, name)[hand], getattr(scene, name)[hand], rtol=1e-6
            )
        used = [g for g in range(scene.ngeom) if scene.geom_bodyid[g] == body]
        meshed = any(piece.kind == "mesh" for piece in obj.pieces)
        filled = rows["geom_dataid"][n] >= 0 if meshed else rows["geom_rbound"][n] > 0.002
        assert filled.sum() == len(used)
        for name in ("geom_size", "geom_rbound", "geom_aabb"):
            row = np.sort(rows[name][n][filled].reshape(len(used), -1), 0)
            np.testing.assert_allclose(
                row, np.sort(getattr(scene, name)[used].reshape(len(used), -1), 0), atol=1e-6
            )
    assert set(rows["geom_dataid"][rows["geom_dataid"] >= 0]) == set(range(meshes.nmesh))


def test_a_reset_changes_only_masked_environments(native, start):
    warp = warp_engine(OBJECTS)
    step = jax.jit(warp.step)
    table = jnp.ones(4, bool)
    state = warp.start(start)
    for i in range(5):
        state, _ = step(state, jnp.asarray(grasp(start, i)), table)
    swapped = _picked(start, [3, 2, 1, 0])
    mask = jnp.array([True, True, False, True])
    mixed = ResetState(
        *(
            jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)
            for a, b in zip(swapped, start, strict=True)
        )
    )
    started = jax.jit(warp.reset)(state, mask, swapped)
    _same(jax.tree.map(lambda leaf: leaf[2], started), jax.tree.map(lambda leaf: leaf[2], state))
    _same(started.reset_state, mixed)
    np.testing.assert_array_equal(warp.read(started).u[mask], 0.0)
    targets = [grasp(start, i) for i in range(20)]
    *_, (x, y, _) = side_by_side(native(OBJECTS), step, mixed, started, targets)
    assert x.contact_found[np.asarray(mask)].any((1, 2)).all()
    for name in ("contact_force", "object_position", "q"):
        of_warp = getattr(y, name)[mask]
        expected = getattr(x, name)[mask]
        np.testing.assert_allclose(
            of_warp, expected, atol=0.5 if name == "contact_force" else 1e-4, err_msg=name
        )
    assert program_count(step) == 1


@pytest.mark.slow
def test_replaced_objects_compile_nothing_and_keep_running_episodes(native, start, others):
    warp = warp_engine(OBJECTS)
    untouched = warp_engine(OBJECTS)
    step = jax.jit(warp.step)
    step_untouched = jax.jit(untouched.step)
    table = jnp.ones(4, bool)
    state = warp.start(start)
    expected = untouched.start(start)
    for i in range(30):
        target = jnp.asarray(grasp(start, i))
        if i in (10, 20):
            state = warp.replace_objects(state, OTHERS if i == 10 else OTHERS[::-1])
        state, after = step(state, target, table)
        expected, after_untouched = step_untouched(expected, target, table)
        _same(after, after_untouched)
    assert after.contact_found.any()
    new = _picked(others, [4, 3, 2, 0])._replace(object_index=jnp.array([0, 1, 2, 4]))
    # Until every object is touched; what slips a moment later does so in each engine by itself.
    targets = [grasp(new, i) for i in range(18)]
    *_, (x, y, _) = side_by_side(
        native(OTHERS[::-1]), step, new, warp.reset(state, table, new), targets
    )
    assert x.contact_found.any((1, 2)).all()
    np.testing.assert_allclose(x.contact_force, y.contact_force, atol=0.5)
    np.testing.assert_allclose(x.object_position, y.object_position, atol=1e-4)
    assert program_count(step) == 1


@pytest.mark.slow
def test_a_compiled_loop_is_the_same_as_single_steps(start):
    """Resets in a branch, two loops after one another, and states that are used twice."""
    warp = warp_engine(OBJECTS)
    targets = jnp.stack([jnp.asarray(grasp(start, i)) for i in range(8, 20)])
    table = jnp.ones(4, bool)
    swapped = _picked(start, [2, 3, 0, 1])

    def advance(state, row):
        i, target = row
        state, after = warp.step(state, target, table)
        mask = jnp.array([True, False, False, True])
        state = jax.lax.cond(i == 3, lambda s: warp.reset(s, mask, swapped), lambda s: s, state)
        return state, (after, warp.read(state))

    loop = jax.jit(lambda state: jax.lax.scan(advance, state, (jnp.arange(len(targets)), targets)))
    first = state = warp.start(start)
    rows = []
    for i, target in enumerate(targets):
        state, row = jax.jit(advance)(state, (jnp.asarray(i), target))
        rows.append(row)
    for _ in range(2):  # the first state is still what it was
        scanned, after = loop(first)
        _same(scanned, state)
        _same(after, jax.tree.map(lambda *leaves: np.stack(leaves), *rows))


def test_meshes_are_absent_from_an_environment_alone_too(start):
    """An unused mesh slot in the middle of a sheet would touch the table."""
    sheet = dataclasses.replace(OBJECTS[0], pieces=(Piece("box", (0.04, 0.04, 0.0003)),))
    warp = warp_engine([sheet])
    step = jax.jit(warp.step)
    occupancy = []
    for batch in (1, 2):
        flat = _picked(start, [0] * batch)._replace(
            object_position=jnp.tile(jnp.array([0.0, 0.0, 0.0003]), (batch, 1)),
            object_quaternion=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (batch, 1)),
        )
        _, after = step(warp.start(flat), jnp.asarray(grasp(flat, 0)), jnp.ones(batch, bool))
        occupancy.append(after.occupancy)
    np.testing.assert_array_equal(*occupancy)


def test_a_diverged_environment_alone_is_flagged_and_reset(start):
    warp = warp_engine(OBJECTS)
    first = warp.start(start)
    target = jnp.asarray(grasp(start, 0))
    table = jnp.ones(4, bool)
    state, _ = warp.step(first, target, table)
    _, expected = warp.step(state, target, table)
    state, after = warp.step(state._replace(qvel=state.qvel.at[1].set(jnp.nan)), target, table)
    np.testing.assert_array_equal(after.diverged, [False, True, False, False])
    assert all(np.isfinite(field).all() for field in after)
    _same(jax.tree.map(lambda leaf: leaf[1], state), jax.tree.map(lambda leaf: leaf[1], first))
    np.testing.assert_allclose(after.q[2:], expected.q[2:], atol=1e-6)
    _, after = warp.step(state, target, table)
    assert not after.diverged.any()


def test_occupancy_equals_mujocos_contact_counts(native, start):
    from congrasp.actors.physics.warp_buffers import (
        CONSTRAINTS_PER_ENVIRONMENT,
        CONTACTS_PER_ENVIRONMENT,
    )

    warp = warp_engine(OBJECTS)
    engine = native(OBJECTS)
    targets = [grasp(start, i) for i in range(5)]
    for _, after, _ in side_by_side(engine, warp.step, start, warp.start(start), targets):
        counts = [
            sum(instance.data.ncon for instance in engine.instances),
            max(instance.data.nefc for instance in engine.instances),
        ]
        room = [4 * CONTACTS_PER_ENVIRONMENT, CONSTRAINTS_PER_ENVIRONMENT]
        np.testing.assert_allclose(after.occupancy[:2], np.divide(counts, room), rtol=1e-5)


def test_overflowing_contacts_are_counted(start, monkeypatch):
    monkeypatch.setattr("congrasp.actors.physics.warp_buffers.CONTACTS_PER_ENVIRONMENT", 2)
    warp = warp_engine(OBJECTS)
    _, crowded = warp.step(warp.start(start), jnp.asarray(grasp(start, 0)), jnp.ones(4, bool))
    assert crowded.occupancy[0] > 1 > crowded.occupancy[1]


def test_steps_whose_solver_reached_its_limit_are_counted(start, monkeypatch):
    """An iteration limit of 1 is reached in every physics step of these environments in contact
    with the table.
    """

    def limit_iterations(iterations):
        def spec(*arguments):
            limited_spec = scene_spec(*arguments)
            limited_spec.option.iterations = iterations
            return limited_spec

        monkeypatch.setattr(slots, "scene_spec", spec)

    limited = []
    for iterations in (1, 100):
        limit_iterations(iterations)
        warp = warp_engine(OBJECTS)
        _, after = warp.step(warp.start(start), jnp.asarray(grasp(start, 0)), jnp.ones(4, bool))
        limited.append(float(after.occupancy[2]))
    assert limited == [1.0, 0.0]


def test_more_pieces_than_slots_are_one_clear_line(start):
    with pytest.raises(
        CongraspError, match=r"'bowl.*' has 8 mesh pieces, but the environments have only 3 slots"
    ):
        warp_engine(OBJECTS, mesh_slots=3)
    warp = warp_engine([OBJECTS[0]], mesh_slots=0)
    state = warp.start(_picked(start, [0]))
    with pytest.raises(CongraspError, match="only 0 slots"):
        warp.replace_objects(state, [OBJECTS[1]])
    boxes = dataclasses.replace(OBJECTS[0], pieces=OBJECTS[0].pieces * 4)
    with pytest.raises(CongraspError, match="more than 3 box pieces"):
        warp.replace_objects(state, [boxes])
    _, after = warp.step(state, jnp.asarray(grasp(state.reset_state, 0)), jnp.ones(1, bool))
    assert not after.diverged.any()


@pytest.mark.slow
def test_an_engine_uses_its_own_ranks_device():
    """Two processes of one job: JAX counts the devices of both."""
    port = free_port()
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "tests.actors.rank_engine"]
    ranks = [
        subprocess.Popen(
            [*command, str(rank), str(port)], env=environment, stdout=subprocess.PIPE, text=True
        )
        for rank in range(2)
    ]
    try:
        for rank, process in enumerate(ranks):
            assert process.communicate(timeout=120.0)[0].splitlines()[-1:] == [f"[{rank}] True"]
    finally:
        for process in ranks:
            process.kill()
