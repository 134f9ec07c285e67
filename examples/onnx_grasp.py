"""Grasps a cylinder with an exported policy: onnxruntime, numpy and mujoco are all that it needs.

    congrasp export policy --to onnx --out policy.onnx
    python examples/onnx_grasp.py policy.onnx

Everything about the hand, the observation and the action comes out of the ONNX file's metadata. The
policy is given an approach heading; the other constraints stay off, so that their blocks of the
observation are zero.
"""

import json
import sys

import mujoco
import numpy as np
import onnxruntime

RADIUS, HALF_HEIGHT, MASS = 0.03, 0.06, 0.2
HEADING = np.array([-1.0, 0.0, -1.0]) / np.sqrt(2)  # approach direction in the object's frame


def matrix(quaternion):
    """Rotation matrix of a quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quaternion, float))
    return out.reshape(3, 3)


def frame(first, second):
    """Rotation matrix with columns (first, second made orthogonal to it, their cross product)."""
    second = second - (second @ first) * first
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], 1)


def shorten(vector, length):
    """The vector, at most this long."""
    return vector * min(1.0, length / max(np.linalg.norm(vector), 1e-9))


def turned(start, end):
    """Twice the vector part of the rotation from one matrix to another, as a quaternion whose w is
    positive.
    """
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, (end @ start.T).ravel())
    return 2.0 * quaternion[1:] * (1.0 if quaternion[0] >= 0 else -1.0)


class Grasp:
    """The scene of the file's hand with a cylinder on the table, and the policy's view of it."""

    def __init__(self, session):
        self.session = session
        stored = session.get_modelmeta().custom_metadata_map
        self.meta = meta = {name: json.loads(value) for name, value in stored.items()}
        self.task, self.control = meta["task"], meta["task"]["control"]
        self.limits = np.array([motor["limits"] for motor in meta["motors"]])
        self.keypoint_links = np.array(meta["keypoint_links"])
        self.keypoint_offsets = (
            np.array(meta["keypoints"]) - np.array(meta["link_origins"])[self.keypoint_links]
        )
        # Keypoints: the links' origins, then the tips, thumb first
        self.tips = slice(len(meta["links"]), None)

        scene, contact = meta["scene"], meta["scene"]["object_contact"]
        spec = mujoco.MjSpec.from_string(scene["mjcf"])
        body = spec.worldbody.add_body(name="object", pos=[0, 0, HALF_HEIGHT])
        body.add_joint(
            name="object", type=mujoco.mjtJoint.mjJNT_FREE, damping=[contact["free_damping"], 0, 0]
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[RADIUS, HALF_HEIGHT, 0],
            mass=MASS,
            friction=contact["friction"],
            condim=contact["condim"],
            solref=contact["solref"],
            solimp=contact["solimp"],
            contype=scene["object_contype"],
            conaffinity=scene["hand_contype"],
        )
        self.model = model = spec.compile()
        self.data = mujoco.MjData(model)
        self.links = [model.body(name).id for name in meta["links"]]
        self.object = model.body("object").id
        self.fingers = [model.joint(name).qposadr[0] for name in meta["joints"]]
        self.finger_speeds = [model.joint(name).dofadr[0] for name in meta["joints"]]
        self.wrist = [model.joint(name).qposadr[0] for name in meta["wrist_joints"]]
        self.wrist_speeds = [model.joint(name).dofadr[0] for name in meta["wrist_joints"]]
        motors = [motor["name"] for motor in meta["motors"]]
        self.ctrl = [model.actuator(name).id for name in (*meta["wrist_joints"], *motors)]
        self.free = model.joint("object").dofadr[0]

        # Points on the cylinder's surface with its normals there, as many as the policy was trained
        # with.
        rng = np.random.default_rng(0)
        angle, n = (
            rng.uniform(0, 2 * np.pi, self.task["surface_points"]),
            self.task["surface_points"],
        )
        height, radius = rng.uniform(-HALF_HEIGHT, HALF_HEIGHT, n), np.full(n, RADIUS)
        lid = rng.random(n) < RADIUS / (RADIUS + 2 * HALF_HEIGHT)
        radius[lid], height[lid] = (
            RADIUS * np.sqrt(rng.random(lid.sum())),
            np.sign(height[lid]) * HALF_HEIGHT,
        )
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], 1)
        self.points = radius[:, None] * outward + height[:, None] * [0.0, 0.0, 1.0]
        self.normals = np.where(lid[:, None], np.sign(height)[:, None] * [0.0, 0.0, 1.0], outward)

        # The thumb and the fingers close around the cylinder's axis: across both the axis and the
        # heading.
        self.heading_position = np.array([0.0, 0.0, 0.01])
        self.target = frame(HEADING, np.cross(HEADING, [0.0, 0.0, 1.0]))
        self.own = frame(
            np.array(meta["grasp_frame"]["heading"]), np.array(meta["grasp_frame"]["cross"])
        )
        self._start()

    def _start(self):
        """Open hand, aligned with the heading and backed off."""
        model, data = self.model, self.data
        data.qpos[self.fingers] = self.meta["open_pose"]
        mujoco.mj_forward(model, data)
        self.object_position, self.object_matrix = (
            data.xpos[self.object].copy(),
            data.xmat[self.object].reshape(3, 3),
        )
        self.object_matrix = self.object_matrix.copy()
        self.base_position, self.base = np.zeros(3), np.eye(3)
        position, turn = self.guidance(self.seen()["center"])
        self.base_position, self.base = (
            position - self.task["back_off"] * (self.object_matrix @ HEADING),
            turn,
        )
        base = model.body("hand_base")
        base.pos = self.base_position
        mujoco.mju_mat2Quat(base.quat, turn.ravel())
        self.q_target, self.u_target, self.time = data.qpos[self.fingers].copy(), np.zeros(6), 0
        self.readings = []  # of the control steps before this one, newest first
        self.momentum = np.zeros(6)  # of the observer of what the wrist carries
        mujoco.mj_forward(model, data)

    def guidance(self, center):
        """The wrist pose in the world at which the hand's centre and axes match the heading."""
        turn = self.target @ self.own.T
        position = self.heading_position - turn @ center
        return self.object_position + self.object_matrix @ position, self.object_matrix @ turn

    def seen(self):
        """Hand and object in the wrist frame."""
        data = self.data
        origin, wrist = data.xpos[self.links[0]], data.xmat[self.links[0]].reshape(3, 3)
        carrier = [self.links[i] for i in self.keypoint_links]
        turns = data.xmat[carrier].reshape(-1, 3, 3)
        keypoints = data.xpos[carrier] + np.einsum("kij,kj->ki", turns, self.keypoint_offsets)
        tips = keypoints[self.tips]
        center = (tips[0] + tips[1:].mean(0)) / 2
        return {
            "wrist": wrist,
            "keypoints": (keypoints - origin) @ wrist,
            "center": (center - origin) @ wrist,
            "object_position": (data.xpos[self.object] - origin) @ wrist,
            "object_matrix": wrist.T @ data.xmat[self.object].reshape(3, 3),
        }

    def forces(self):
        """(L, 3) net force of the object on each link in the world, and (L,) which links touch
        it.
        """
        force, touching = np.zeros((len(self.links), 3)), np.zeros(len(self.links))
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            bodies = [self.model.geom_bodyid[geom] for geom in contact.geom]
            if self.object not in bodies:
                continue
            other = bodies[0] if bodies[1] == self.object else bodies[1]
            if other in self.links:
                local = np.zeros(6)
                mujoco.mj_contactForce(self.model, self.data, i, local)
                on_second = contact.frame.reshape(3, 3).T @ local[:3]
                force[self.links.index(other)] += on_second if other == bodies[1] else -on_second
                touching[self.links.index(other)] = 1.0
        return force, touching

    def read(self):
        """Current joint positions of fingers and wrist, the targets of both, and the object's
        pose.
        """
        data = self.data
        position, matrix = (
            data.xpos[self.object].copy(),
            data.xmat[self.object].reshape(3, 3).copy(),
        )
        return (
            data.qpos[self.fingers],
            data.qpos[self.wrist],
            self.q_target,
            self.u_target,
            position,
            matrix,
        )

    def past(self, wrist):
        """Fields of a policy that looks back instead of seeing forces and velocities, turned to the
        wrist frame.
        """
        q, u, _, _, position, matrix = self.read()
        steps = self.task.get("history", 2) - 1
        rows = (self.readings or [self.read()])[:steps]
        past_q, past_u, q_target, u_target, positions, matrices = map(
            np.array, zip(*(rows + rows[-1:] * (steps - len(rows))), strict=True)
        )
        return {
            "past q - q": past_q - q,
            "past u - u": past_u - u,
            "past q_target - past q": q_target - past_q,
            "past u_target - past u": u_target - past_u,
            "past object_position": (positions - position) @ wrist,
            "past object_rotation": np.array([turned(old, matrix) for old in matrices]) @ wrist,
        }

    def observe(self):
        """(D,) the observation, as the file's "observation" lists it."""
        data, seen, task = self.data, self.seen(), self.task
        wrist, local = seen["wrist"], seen["object_matrix"]
        force, touching = self.forces()
        force = force @ wrist
        points = self.points @ local.T + seen["object_position"]
        nearest = np.linalg.norm(seen["keypoints"][:, None] - points, axis=-1).argmin(1)
        normal = self.normals[nearest] @ local.T
        now = data.xmat[self.object].reshape(3, 3)
        q, u = data.qpos[self.fingers], data.qpos[self.wrist]
        position = local @ self.heading_position + seen["object_position"]
        fields = {
            "q": q,
            "u": u,
            "q_target - q": self.q_target - q,
            "u_target - u": self.u_target - u,
            "q_velocity": data.qvel[self.finger_speeds],
            "u_velocity": data.qvel[self.wrist_speeds],
            "touching": touching,
            "force": force
            / (np.linalg.norm(force, axis=1, keepdims=True) + self.meta["force_scale"]),
            "nearest": points[nearest] - seen["keypoints"],
            "normal": normal,
            "height": ((seen["keypoints"] - points[nearest]) * normal).sum(1),
            "object_velocity": data.qvel[self.free : self.free + 3] @ wrist,
            "object_angular_velocity": now @ data.qvel[self.free + 3 : self.free + 6] @ wrist,
            "object_displacement": (data.xpos[self.object] - self.object_position) @ wrist,
            "object_rotation": turned(self.object_matrix, now) @ wrist,
            "time": min(self.time / (task["approach_steps"] + task["hold_steps"]), 1.0),
            "table": float(self.time < task["approach_steps"]),
            "center": seen["center"],
            "heading_position": position,
            "heading_position - center": position - seen["center"],
            "heading_direction": local @ HEADING,
            "object_matrix": local,
            **self.past(wrist),
        }
        numbers = [
            np.ravel(fields.get(f["field"], np.zeros(f["size"]))) for f in self.meta["observation"]
        ]
        return np.concatenate(numbers).astype(np.float32)

    def lead(self, ahead, residual, speed):
        """Lead of the wrist's targets over its position, within its limits of speed and
        acceleration.
        """
        table = self.time < self.meta["task"]["approach_steps"]
        share = 1.0 if table else self.control["hold_acceleration"]
        found = []
        for part, kind in ((slice(0, 3), "position"), (slice(3, 6), "rotation")):
            servo, most = self.meta["wrist"][kind], self.control[f"guidance_{kind}_limit"]
            steady = servo["kv"] / servo["kp"] * speed[part]
            wanted = shorten(shorten(ahead[part], most) + residual[part], most)
            limit = self.control[servo["limit"]]
            slowing = servo["kp"] / servo["kv"] * np.linalg.norm(speed[part])
            hardest = (
                servo["inertia"] / servo["kp"] * (np.clip(slowing, share * limit, limit) or np.inf)
            )
            carried = (
                0.0 if table else shorten(-self.load()[part] * servo["inertia"] / servo["kp"], most)
            )
            found.append(steady + shorten(wanted - steady, hardest) + carried)
        return np.concatenate(found)

    def load(self):
        """(6,) acceleration of the wrist by everything but its servos, m/s^2 and rad/s^2."""
        return self.control["load_rate"] * (self.generalised_speed() - self.momentum)

    def generalised_speed(self):
        """(6,) v + (damping - stiffness dt / 2) u of the wrist; servos and load make up its rate of
        change.
        """
        stiffness, damping = self.servos()
        factor = damping - 0.5 * self.task["control_dt"] * stiffness
        return self.data.qvel[self.wrist_speeds] + factor * self.data.qpos[self.wrist]

    def servos(self):
        """(2, 6) stiffness (1/s^2) and damping (1/s) of the wrist's servos."""
        kinds = [self.meta["wrist"][kind] for kind in ("position", "rotation")]
        return np.repeat(
            [[kind[gain] / kind["inertia"] for kind in kinds] for gain in ("kp", "kv")], 3, 1
        )

    def track_load(self):
        """Updates the momentum of the load observer after a control step."""
        stiffness, _ = self.servos()
        gained = stiffness * (self.u_target - self.data.qpos[self.wrist])
        decay = self.task["control_dt"] * self.control["load_rate"]
        gained = self.task["control_dt"] * gained + decay * self.generalised_speed()
        self.momentum = (self.momentum + gained) / (1 + decay)

    def step(self):
        """Asks the policy, turns its action into joint targets, and steps the physics."""
        (action,) = self.session.run(["action"], {"observation": self.observe()[None]})
        self.readings = [self.read(), *self.readings]
        scale = np.array([entry["scale"] for entry in self.meta["action"]])
        motors = self.meta["motors"]
        fingers, wrist = np.split(scale * action[0], [len(motors)])
        before = dict(zip(self.meta["joints"], self.q_target, strict=True))
        now = np.array(
            [sum(c * before[joint] for joint, c in motor["pulls"].items()) for motor in motors]
        )
        now = np.clip(now + fingers, *self.limits.T)
        targets = {
            joint: place["ratio"] * position + place["rest"]
            for motor, position in zip(motors, now, strict=True)
            for joint, place in motor["moves"].items()
        }
        self.q_target = np.array([targets[joint] for joint in self.meta["joints"]])

        position, turn = self.guidance(self.seen()["center"])
        relative = self.base.T @ turn
        angles = [
            np.arctan2(-relative[1, 2], relative[2, 2]),
            np.arcsin(np.clip(relative[0, 2], -1, 1)),
            np.arctan2(-relative[0, 1], relative[0, 0]),
        ]
        u = self.data.qpos[self.wrist]
        ahead = np.concatenate([self.base.T @ (position - self.base_position), angles]) - u
        ahead[3:] = (ahead[3:] + np.pi) % (2 * np.pi) - np.pi
        self.u_target = u + self.lead(ahead, wrist, self.data.qvel[self.wrist_speeds])

        self.data.ctrl[self.ctrl] = np.concatenate([self.u_target, now])
        if self.time == self.task["approach_steps"]:
            self.data.mocap_pos[self.model.body("table").mocapid[0]] = self.meta["scene"][
                "table_away"
            ]
        mujoco.mj_step(self.model, self.data, self.task["substeps"])
        mujoco.mj_forward(self.model, self.data)
        self.track_load()
        self.time += 1


def main():
    """Runs one grasp and prints its outcome."""
    path = sys.argv[1] if len(sys.argv) > 1 else "policy.onnx"
    grasp = Grasp(onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"]))
    steps = grasp.task["approach_steps"] + 200  # two seconds after the table is removed
    heights = []
    for _ in range(steps):
        grasp.step()
        heights.append(grasp.data.xpos[grasp.object][2])
    removal = heights[grasp.task["approach_steps"] - 1]
    links = int(grasp.forces()[1].sum())
    held = heights[-1] > removal - grasp.task["drop_height"]
    print(
        f"{grasp.meta['hand']} hand, policy version {grasp.meta['version']}: "
        f"the cylinder is {'held' if held else 'lost'} "
        f"two seconds after the table is removed, {1000 * (heights[-1] - removal):+.1f} mm, "
        f"{links} links in contact"
    )
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
