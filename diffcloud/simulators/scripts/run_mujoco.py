"""Run the cloth of cloth.xml in MuJoCo, its held nodes moved as they were recorded.

    pip install mujoco==4.0.0 numpy
    python run_mujoco.py              writes nodes.npz: nodes [T, V, 3] [m] at times [T] [s]
    python run_mujoco.py --view       shows it instead; writes nothing

To use the cloth in your own model, copy <asset>, <worldbody>, <deformable> and <option> of cloth.xml. Instead of
mj_step, call `advance` with the positions in which your gripper holds the nodes.
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np


def advance(model, data, held, now, after):
    """Make one time step in which the held nodes move to their next positions.

    Args:
        held: indices of the K held nodes.
        now: [K, 3] current positions [m].
        after: [K, 3] positions after the step [m].
    """
    positions_of, velocities_of = node_places(model)
    data.qpos[positions_of[held]] = now - model.body_pos[node_bodies(model)[held]]
    data.qvel[velocities_of[held]] = (after - now) / model.opt.timestep
    mujoco.mj_step(model, data)


def node_bodies(model):
    """[V] body index of each node of the cloth. The model may have other flexes too."""
    cloth = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, "cloth")
    first = model.flex_vertadr[cloth]
    return model.flex_vertbodyid[first : first + model.flex_vertnum[cloth]]


def node_places(model):
    """[V, 3] indices of each node in qpos and in qvel, for its three slide joints."""
    bodies = node_bodies(model)
    joints = model.body_jntadr[bodies]
    return model.jnt_qposadr[joints][:, None] + np.arange(3), model.body_dofadr[bodies][:, None] + np.arange(3)


def positions(model, data):
    """[V, 3] positions of all nodes [m]."""
    return model.body_pos[node_bodies(model)] + data.qpos[node_places(model)[0]]


def frames(model, data, held, wanted, every):
    """Yield node positions [V, 3] [m] at the start and after every `every` steps.

    Args:
        wanted: [S + 1, K, 3] positions of the held nodes at the start and after each step [m].
    """
    yield positions(model, data)
    for number in range(len(wanted) - 1):
        advance(model, data, held, wanted[number], wanted[number + 1])
        if (number + 1) % every == 0:
            yield positions(model, data)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--view", action="store_true", help="show the motion in MuJoCo's viewer")
    parser.add_argument("--out", type=Path, default=Path("nodes.npz"), help="where to write the nodes")
    chosen = parser.parse_args()
    folder = Path(__file__).resolve().parent
    model = mujoco.MjModel.from_xml_path(str(folder / "cloth.xml"))
    data = mujoco.MjData(model)
    with np.load(folder / "cloth.npz") as told:
        held, times, keys, motion = told["held"], told["times"], told["motion_times"], told["motion"]
    step = model.opt.timestep
    every = round((times[1] - times[0]) / step)
    steps = np.arange(every * (len(times) - 1) + 1) * step
    wanted = np.stack([[np.interp(steps, keys, motion[:, k, axis]) for axis in range(3)] for k in range(len(held))])
    made = frames(model, data, held, wanted.transpose(2, 0, 1), every)
    if not chosen.view:
        np.savez(chosen.out, nodes=np.array(list(made)), times=times)
        return
    from mujoco import viewer

    with viewer.launch_passive(model, data) as shown:
        for _ in made:
            shown.sync()
            time.sleep(every * step)


if __name__ == "__main__":
    main()
