"""Which topics of a bag are used: chosen by the user, or the only one of a kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from hybridlio.core.errors import DataError
from hybridlio.core.tables import counted
from hybridlio.datasets.notes import Notes
from hybridlio.datasets.rosbag.bag import LIVOX_PACKAGES, Bag, Topic
from hybridlio.datasets.rosbag.choices import NONE, BagTopics, option_of

LIVOX_TYPES = frozenset(f"{package}/CustomMsg" for package in LIVOX_PACKAGES)
TYPES: dict[str, frozenset[str]] = {
    "lidar": frozenset({"sensor_msgs/PointCloud2"}) | LIVOX_TYPES,
    "imu": frozenset({"sensor_msgs/Imu"}),
    "gps": frozenset({"sensor_msgs/NavSatFix"}),
    "reference": frozenset(
        {
            "nav_msgs/Odometry",
            "geometry_msgs/PoseStamped",
            "geometry_msgs/PoseWithCovarianceStamped",
            "geometry_msgs/TransformStamped",
        }
    ),
}
OTHER_LIDAR = "lidar "
TRANSFORM_TYPES = frozenset({"tf2_msgs/TFMessage", "tf/tfMessage"})
_PACKETS = frozenset({"velodyne_msgs/VelodyneScan", "ouster_ros/PacketMsg", "ouster_sensor_msgs/PacketMsg"})


def choose(bag: Bag, wanted: BagTopics, notes: Notes) -> dict[str, Topic]:
    """Return the topics to use, by kind: ``lidar``, and of ``imu``, ``gps`` and ``reference`` those that there are.

    Further lidars that the user names are of kinds that begin with :data:`OTHER_LIDAR`.

    Raises:
        DataError: a wanted topic does not exist or has another type, there is no lidar, or there are several lidars or
            IMUs; the message lists topics, and the option to choose one.
    """
    first, *others = wanted.lidars or (None,)
    found = {kind: _choose(bag, kind, first if kind == "lidar" else getattr(wanted, kind), notes) for kind in TYPES}
    for name in others:
        topic = _choose(bag, "lidar", name, notes)
        if topic in found.values():
            raise DataError(f"{bag.path}: --lidar-topic: {topic.name if topic else name} is named twice")
        found[f"{OTHER_LIDAR}{name}"] = topic
    return {kind: topic for kind, topic in found.items() if topic is not None}


def _choose(bag: Bag, kind: str, name: str | None, notes: Notes) -> Topic | None:
    if name == NONE:
        return None
    option, fitting = option_of(kind), [topic for topic in bag.topics.values() if topic.type in TYPES[kind]]
    if name is not None:
        known = bag.topics.get(name) or bag.topics.get(f"/{name}")
        if known is None or known.type not in TYPES[kind]:
            problem = "no such topic" if known is None else f"its type is {known.type}"
            listed = fitting or bag.topics.values()
            raise DataError(f"{bag.path}: {option} {name}: {problem}; topics:\n{table(listed)}")
        return known
    if len(fitting) > 1 and kind in ("lidar", "imu"):
        raise DataError(
            f"{bag.path}: {len(fitting)} {kind} topics; choose one, for example {option} {_most(fitting).name}"
            + (", or several to merge them\n" if kind == "lidar" else "\n")
            + table(fitting)
        )
    if len(fitting) > 1:
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in fitting)
        what = {"gps": "GPS fixes", "reference": "reference poses"}[kind]
        notes.add(f"no {what} used: {counted(len(fitting), 'topic')} could give them; choose by {option}: {names}")
        return None
    if not fitting and kind == "lidar":
        raise DataError(_no_lidar(bag))
    return fitting[0] if fitting else None


def _no_lidar(bag: Bag) -> str:
    packets = [topic for topic in bag.topics.values() if topic.type in _PACKETS]
    remedy = f"; {packets[0].name} holds raw packets, record the driver's points" if packets else ""
    types = ", ".join(sorted(TYPES["lidar"]))
    return f"{bag.path}: no topic of point clouds ({types}){remedy}. Its topics:\n{table(bag.topics.values())}"


def _most(topics: Iterable[Topic]) -> Topic:
    return max(topics, key=lambda topic: topic.count)


def _rate(topic: Topic) -> str:
    return f"{topic.rate_hz:.1f} Hz" if topic.rate_hz else ""


def table(topics: Iterable[Topic], marks: Mapping[str, str] | None = None) -> str:
    """Return lines that list topics with types, counts and rates; ``marks`` are words put behind some of them."""
    marks = marks or {}
    rows = [(t.name, t.type, str(t.count), _rate(t), marks.get(t.name, "")) for t in topics]
    if not rows:
        return "  (none)"
    width = [max(len(row[column]) for row in rows) for column in range(4)]
    return "\n".join(
        f"  {n:<{width[0]}}  {k:<{width[1]}}  {c:>{width[2]}}  {r:>{width[3]}}  {m}".rstrip() for n, k, c, r, m in rows
    )
