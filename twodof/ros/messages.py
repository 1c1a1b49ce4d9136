"""ROS 2 messages of a sample, their topics and quality of service."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from struct import Struct
from typing import TYPE_CHECKING, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..errors import BagError, InputError
from ..fmu import resource_reader
from ..plant.urdf import Joint, RobotError
from ..simulation.experiments import NANOSECONDS, Experiment
from ..simulation.input_values import Value
from ..simulation.judge import OUTPUTS
from ..simulation.sample import Sample
from .cdr import Array, Layout, Numbers, Rows, Stamp, joint_state_layout

if TYPE_CHECKING:
    from .scene import Scene

JOINT_STATES = "/joint_states"
TRUE_STATES = "/joint_states_true"
SENSORS = ("q_resolution", "q_noise", "v_noise", "v_from_q")
JOINT_STATE = "sensor_msgs/msg/JointState"
TRANSFORMS = "/tf"
TARGET = "/target"
END_EFFECTOR = "/end_effector"
SIGNALS = "/signals/values"
SIGNAL_NAMES = "/signals/names"
CLOCK = "/clock"
POINT = "geometry_msgs/msg/PointStamped"
POSE = "geometry_msgs/msg/PoseStamped"
NAMES = "pal_statistics_msgs/msg/StatisticsNames"
VALUES = "pal_statistics_msgs/msg/StatisticsValues"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
FOREVER = QosTime(9223372036, 854775807)

XYZ = "float64 x\nfloat64 y\nfloat64 z"
DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "rosgraph_msgs/msg/Clock": "builtin_interfaces/Time clock",
    "std_msgs/msg/Bool": "bool data",
    "std_msgs/msg/UInt32": "uint32 data",
    "std_msgs/msg/String": "string data",
    JOINT_STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
    "geometry_msgs/msg/Point": XYZ,
    "geometry_msgs/msg/Vector3": XYZ,
    "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    POINT: "std_msgs/Header header\ngeometry_msgs/Point point",
    POSE: "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "trajectory_msgs/msg/JointTrajectoryPoint": "float64[] positions\nfloat64[] velocities\n"
    "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start",
    JOINT_TRAJECTORY: "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points",
    NAMES: "std_msgs/Header header\nstring[] names\nuint32 names_version",
    VALUES: "std_msgs/Header header\nfloat64[] values\nuint32 names_version",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}
"""Definitions of Humble; the import of rosbags' store of all types of Humble takes longer than that of NumPy."""
_STORE = get_typestore(Stores.EMPTY)


@cache
def store_of(kind: str) -> Typestore:
    """Return rosbags' type store with one type and its parts; loading all types is slow."""
    for line in DEFINITIONS[kind].splitlines():
        package, slash, name = line.partition(" ")[0].removesuffix("[]").partition("/")
        if slash:
            store_of(f"{package}/msg/{name}")
    _STORE.register(get_types_from_msg(DEFINITIONS[kind], kind))
    return _STORE


def definition(kind: str) -> str:
    """Return the definition of a type and of its parts in the form of bags."""
    return store_of(kind).generate_msgdef(kind, ros_version=2)[0]


def check_name(argument: str, name: str) -> None:
    """Refuse an invalid ROS 2 name."""
    if name and not re.fullmatch(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", name, re.ASCII):
        raise InputError(f"`{argument}` '{name}' is not a valid ROS 2 name")


class Topic(NamedTuple):
    """Message type and offered quality of service of a topic."""

    type: str
    qos: Qos


STREAM = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    FOREVER,
    FOREVER,
    QosLiveliness.AUTOMATIC,
    FOREVER,
    False,
)
LATCHED = STREAM._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)
SCENE_TOPICS = {
    "/robot_description": Topic("std_msgs/msg/String", LATCHED),
    "/tf_static": Topic("tf2_msgs/msg/TFMessage", LATCHED),
    TRANSFORMS: Topic("tf2_msgs/msg/TFMessage", STREAM._replace(depth=100)),
    TARGET: Topic(POINT, STREAM),
    END_EFFECTOR: Topic(POINT, STREAM),
}


def has_sensors(run: Experiment) -> bool:
    """Return whether a run measures joint states that differ from the true ones."""
    settings = ((name.rpartition(".")[2].partition("[")[0], value) for name, value in run.start_values.items())
    return bool(run.fmu.vector("q_meas")) and any(name in SENSORS and value for name, value in settings)


class Messages:
    """The messages of a run, serialised.

    Args:
        scene: add the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        clock: add the samples' stamps on /clock.
        measured: /joint_states has the measured values; the true ones have their own topic.

    Attributes:
        topics: all topics by name.

    Raises:
        BagError: the FMU lacks a requested output.
    """

    def __init__(
        self,
        run: Experiment,
        *,
        scene: bool,
        effort: bool,
        clock: bool = False,
        meshes_in: str = "",
        measured: bool = False,
    ) -> None:
        if effort and not run.fmu.vector("tau"):
            raise BagError(f"'{run.fmu.path}' has no outputs tau[i], which `effort` records")
        if measured and not run.fmu.vector("q_meas"):
            raise BagError(f"'{run.fmu.path}' has no outputs q_meas[i] and v_meas[i], which `measured` records")
        self._scene = _load_scene(run, meshes_in) if scene else None
        self._axes, self._signals = ["xyz".index(axis) for axis in run.fmu.axes], run.signals
        self._version = crc32("\n".join(run.signals).encode())  # PlotJuggler 3 knows names by their version alone
        n, m, poses = len(run.fmu.joints), 0, False
        efforts = n if effort else 0
        layouts: dict[str, Layout] = {CLOCK: Layout(Stamp())} if clock else {}
        layouts[JOINT_STATES] = joint_state_layout(run.fmu.joints, "", (n, n, efforts))
        self.topics = {JOINT_STATES: Topic(JOINT_STATE, STREAM)}
        if measured:
            layouts[TRUE_STATES] = joint_state_layout(run.fmu.joints, "", (n, n, 0))
            self.topics[TRUE_STATES] = Topic(JOINT_STATE, STREAM)
        if self._scene is not None:
            m, poses = len(run.fmu.vector("x_des")), bool(run.fmu.vector("quat_des"))
            point = Layout(Stamp(), run.fmu.root, Numbers(7 if poses else 3))
            layouts |= {TRANSFORMS: _tf_layout(self._scene.moving), TARGET: point}
            layouts |= {END_EFFECTOR: point}
            self.topics |= SCENE_TOPICS
            if poses:
                self.topics |= dict.fromkeys((TARGET, END_EFFECTOR), Topic(POSE, STREAM))
            if not m:
                del self.topics[TARGET], layouts[TARGET]
        if self._signals:
            layouts[SIGNALS] = Layout(Stamp(), "", len(self._signals), Numbers(len(self._signals)), self._version)
            self.topics |= {SIGNAL_NAMES: Topic(NAMES, LATCHED), SIGNALS: Topic(VALUES, STREAM)}
        if clock:
            self.topics[CLOCK] = Topic("rosgraph_msgs/msg/Clock", STREAM)
        self._layouts, self._efforts, turns = layouts, efforts, 4 * poses
        self._measured, self._step, seen = measured, run.step, n if measured else 0
        sizes = {
            "q": n,
            "v": n,
            "signals": len(self._signals),
            "q_meas": seen,
            "v_meas": seen,
            "tau": efforts,
            "quat": turns,
            "x_des": m,
            "quat_des": turns,
        }
        self._numbers = np.dtype([("stamp", "<i8"), *((k, "<f8", (c,)) for k, c in sizes.items())])
        self._pack = Struct(f"<q{sum(sizes.values())}d").pack
        self._inputs: Mapping[str, Value] = {}
        self._target: tuple[float, ...] = ()

    @property
    def size(self) -> int:
        """Bytes of the messages of one sample."""
        return sum(layout.size for layout in self._layouts.values())

    def numbers(self, sample: Sample) -> bytes:
        """Return the packed numbers of one sample's messages, which may be joined with those of other samples."""
        given = (*sample.signals, *sample.q_meas, *sample.v_meas) if self._measured else sample.signals
        given = (*given, *sample.tau) if self._efforts else given
        if self._scene is not None:
            if sample.inputs is not self._inputs:
                self._inputs = sample.inputs
                self._target = (*(sample.target or ()), *(sample.target_quat or ()))
            given = (*given, *sample.quat, *self._target)
        return self._pack(sample.stamp, *sample.q, *sample.v, *given)

    def numbers_of(self, values: NDArray[np.float64], first: Sample, k: int) -> bytes:
        """Return the packed numbers of samples from index k on, by their OUTPUTS and the inputs of the first sample."""
        sizes = [len(getattr(first, name)) for name in OUTPUTS]
        table, begin = np.zeros(len(values), self._numbers), 0
        later = np.rint(np.arange(k, k + len(values)) * self._step * NANOSECONDS)
        table["stamp"] = first.stamp + later.astype(np.int64)
        for name, size in zip(OUTPUTS, sizes):
            if name != "x" and table[name].shape[1]:
                table[name] = values[:, begin : begin + size]
            begin += size
        for name, target in (("x_des", first.target), ("quat_des", first.target_quat)):
            if table[name].shape[1]:
                table[name] = target
        return table.tobytes()

    def of(self, sample: Sample) -> dict[str, Rows]:
        """Return the messages of one sample, by topic."""
        return self.of_all(self.numbers(sample))[1]

    def of_all(self, numbers: bytes) -> tuple[NDArray[np.int64], dict[str, Rows]]:
        """Return the stamps of N samples, ns, and their messages by topic."""
        table = np.frombuffer(numbers, self._numbers)
        seen = ("q_meas", "v_meas", "tau") if self._measured else ("q", "v", "tau")
        parts = {CLOCK: [], JOINT_STATES: [table[key] for key in seen]}
        parts[SIGNALS] = [table["signals"]]
        parts[TRUE_STATES] = [table["q"], table["v"], table["tau"][:, :0]]
        if self._scene is not None:
            end_effector = self._scene.end_effector(table["q"])
            target = end_effector.copy()  # axes that are not controlled keep the end effector's position
            if TARGET in self._layouts:
                target[:, self._axes] = table["x_des"]
            parts |= {
                TRANSFORMS: self._scene.transforms(self._scene.moving, table["q"]),
                END_EFFECTOR: [np.hstack([end_effector, table["quat"]])],
                TARGET: [np.hstack([target, table["quat_des"]])],
            }
        stamps = table["stamp"]
        return stamps, {t: layout.pack(stamps, *parts[t]) for t, layout in self._layouts.items()}

    def latched(self, stamp: int | np.int64) -> dict[str, Rows]:
        """Return the messages that hold for the whole run: names of signals, robot description and fixed transforms.

        ``stamp`` is their time stamp, ns since the epoch.
        """
        return {topic: layout.pack(np.array([stamp])) for topic, layout in self._latched_layouts().items()}

    def templates(self) -> dict[str, dict[str, object]]:
        """Return the templates of all messages by topic, those that hold for the whole run first."""
        layouts = self._latched_layouts() | self._layouts
        return {topic: layout.template() for topic, layout in layouts.items()}

    def _latched_layouts(self) -> dict[str, Layout]:
        layouts: dict[str, Layout] = {}
        if self._signals:
            layouts[SIGNAL_NAMES] = Layout(Stamp(), "", len(self._signals), *self._signals, self._version)
        if self._scene is not None:
            fixed = self._scene.transforms(self._scene.fixed, np.empty((1, 0)))
            layouts["/robot_description"] = Layout(self._scene.description)
            layouts["/tf_static"] = _tf_layout(self._scene.fixed, [pose[0] for pose in fixed])
        return layouts


def _load_scene(run: Experiment, meshes_in: str) -> Scene:
    urdf = run.fmu.urdf
    if urdf is None or not run.fmu.axes:
        raise BagError(f"'{run.fmu.path}' contains no robot.urdf, which a scene shows")
    from .scene import Scene  # SciPy takes half a second to import

    try:
        return Scene(urdf, run.fmu.joints, run.fmu.frame, resource_reader(run.fmu), meshes_in)
    except RobotError as error:
        raise BagError(f"'{run.fmu.path}': resources/robot.urdf: {error}") from error


def _tf_layout(joints: Sequence[Joint], poses: Sequence[Array] | None = None) -> Layout:
    """Return the layout of a TFMessage: a transform for each joint, from parent to child link; constant with poses."""
    parts: list[Stamp | str | Array | Numbers] = []
    for k, joint in enumerate(joints):
        parts += (Stamp(), joint.parent, joint.child, Numbers(7) if poses is None else poses[k])
    return Layout(len(joints), *parts)
