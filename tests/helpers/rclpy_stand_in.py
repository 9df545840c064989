"""What the ROS 2 node uses of rclpy and of generated messages, with the rules that ROS 2 holds its users to.

ROS 2 is not in Debian and not on PyPI, so the node runs on this in tests. Messages are classes made from the
definitions of ROS 2 Humble in ``rosbags``, which check what is assigned as those of ``rosidl`` do: types, bounds of
integers, lengths of arrays, and that numbers of floating point are no integers. Callbacks of one group run one after
another, those of two groups at once.
"""

from __future__ import annotations

import array
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import bags
import numpy as np
from rosbags.interfaces import Nodetype

_INTEGERS = {f"{sign}int{bits}": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}
_CODES = {"uint8": "B", "float64": "d", "float32": "f", "int8": "b"}
_MESSAGES = (
    *("builtin_interfaces/Time", "geometry_msgs/TransformStamped", "nav_msgs/Odometry", "tf2_msgs/TFMessage"),
    *("sensor_msgs/Imu", "sensor_msgs/PointCloud2"),
)
_classes: dict[str, type] = {}


def message_class(name: str) -> type:
    """Return the class of a message, such as ``nav_msgs/msg/Odometry``."""
    if name not in _classes:
        _, fields = bags.typestore(True).fielddefs[name]
        made = {field: _property(field, kind) for field, kind in fields}
        _classes[name] = type(name.split("/")[-1], (_Message,), {"_fields": dict(fields), **made})
    return _classes[name]


class _Message:
    _fields: ClassVar[dict[str, Any]] = {}

    def __init__(self, **values: Any) -> None:
        assert set(values) <= set(self._fields), f"no such fields: {set(values) - set(self._fields)}"
        for name, kind in self._fields.items():
            setattr(self, name, values[name] if name in values else _default(kind))


def _property(name: str, kind: Any) -> property:
    def assign(message: Any, value: Any) -> None:
        message.__dict__[f"_{name}"] = _checked(name, kind, value)

    return property(lambda message: message.__dict__[f"_{name}"], assign)


def _default(kind: Any) -> Any:
    what, of = kind
    if what == Nodetype.NAME:
        return message_class(of)()
    if what == Nodetype.BASE:
        return {"string": "", "bool": False}.get(of[0], 0 if of[0] in _INTEGERS else 0.0)
    (inner, name), count = of
    return [_default((inner, name)) for _ in range(count)] if what == Nodetype.ARRAY else []


def _checked(name: str, kind: Any, value: Any) -> Any:
    what, of = kind
    if what == Nodetype.NAME:
        assert isinstance(value, message_class(of)), f"{name} must be a {of}, got {type(value)}"
        return value
    if what == Nodetype.BASE:
        return _checked_number(name, of[0], value)
    element, count = of
    assert isinstance(value, Sequence | np.ndarray | array.array), name
    assert not isinstance(value, str), name
    assert what == Nodetype.SEQUENCE or len(value) == count, f"{name} has {len(value)} of {count} values"
    if element[0] == Nodetype.BASE and element[1][0] in _CODES:
        code = _CODES[element[1][0]]
        if isinstance(value, list):
            for number in value:
                _checked_number(name, element[1][0], number)
        fixed = what == Nodetype.ARRAY
        return np.array(value, code) if fixed else array.array(code, np.asarray(value, code).tobytes())
    return [_checked(name, element, one) for one in value]


def _checked_number(name: str, kind: str, value: Any) -> Any:
    if kind in _INTEGERS:
        sign, bits = _INTEGERS[kind]
        low, high = (0, 2**bits) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        assert isinstance(value, int), f"{name} must be a {kind}, got {value!r}"
        assert low <= value < high, f"{name} must be a {kind}, got {value!r}"
    else:
        wanted = {"string": str, "bool": bool}.get(kind, float)
        assert isinstance(value, wanted), f"{name} must be a {wanted.__name__}, got {value!r}"
    return value


def received(message: Any, name: str) -> Any:
    """Return a message of ``rosbags`` as a subscriber gets it."""
    values = {}
    for field, (what, of) in message_class(name)._fields.items():
        value = getattr(message, field)
        if what == Nodetype.NAME:
            value = received(value, of)
        elif what in (Nodetype.ARRAY, Nodetype.SEQUENCE) and of[0][0] == Nodetype.NAME:
            value = [received(one, of[0][1]) for one in value]
        values[field] = value
    return message_class(name)(**values)


class Graph:
    """The topics of one process: what its node gets and publishes.

    Attributes:
        parameters: as given on the command line.
        published: topic and message, in order.
        batches: messages for subscriptions, topic and message, in order of arrival; a batch arrives at once.
        between: called between two batches.
    """

    def __init__(
        self, parameters: dict[str, Any], batches: list[list[tuple[str, Any]]], between: Callable[[Graph], None]
    ) -> None:
        self.parameters, self.batches, self.between = parameters, batches, between
        self.published: list[tuple[str, Any]] = []
        self.subscriptions: dict[str, tuple[type, Callable[[Any], None], Any]] = {}
        self.is_up = False

    def messages(self, topic: str) -> list[Any]:
        """Return what was published on a topic so far."""
        return [message for name, message in list(self.published) if name == topic]

    def deliver(self) -> None:
        """Call back with all messages, the groups in threads of their own; then Ctrl-C comes."""
        for number, batch in enumerate(self.batches):
            if number:
                self.between(self)
            groups: dict[int, list[tuple[Callable[[Any], None], Any]]] = {}
            for topic, message in batch:
                kind, callback, group = self.subscriptions[topic]
                assert isinstance(message, kind), f"{topic} has messages of {type(message)}"
                groups.setdefault(id(group), []).append((callback, message))
            threads = [threading.Thread(target=_call, args=(calls,)) for calls in groups.values()]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        raise KeyboardInterrupt


def _call(calls: list[tuple[Callable[[Any], None], Any]]) -> None:
    for callback, message in calls:
        callback(message)


class Publisher:
    """Of a node; it takes messages of its type alone."""

    def __init__(self, kind: type, topic: str) -> None:
        self._kind, self._topic = kind, topic

    def publish(self, message: Any) -> None:
        assert _graph().is_up
        assert isinstance(message, self._kind)
        _graph().published.append((self._topic, message))


@dataclass
class Parameter:
    """A parameter of a node."""

    value: Any


class Node:
    """As ``rclpy.node.Node``."""

    def __init__(self, node_name: str) -> None:
        assert _graph().is_up, "rclpy.init() comes first"
        self.name = node_name

    def declare_parameter(self, name: str, value: Any) -> Parameter:
        given = _graph().parameters.get(name, value)
        assert type(given) is type(value), f"parameter {name} has another type than its default"
        return Parameter(given)

    def create_publisher(self, msg_type: type, topic: str, qos_profile: Any) -> Publisher:
        assert isinstance(qos_profile, int)
        return Publisher(msg_type, topic)

    def create_subscription(
        self, msg_type: type, topic: str, callback: Any, qos_profile: Any, *, callback_group: Any = None
    ) -> None:
        assert qos_profile is _SENSOR_DATA
        _graph().subscriptions[topic] = (msg_type, callback, callback_group)


class MutuallyExclusiveCallbackGroup:
    """Callbacks of one run one after another."""


class MultiThreadedExecutor:
    """As that of ``rclpy.executors``, for one node."""

    def __init__(self, num_threads: int | None = None) -> None:
        assert num_threads is None or num_threads > 0
        self.nodes: list[Node] = []

    def add_node(self, node: Node) -> bool:
        self.nodes.append(node)
        return True

    def spin(self) -> None:
        assert self.nodes
        assert _graph().is_up
        _graph().deliver()


_SENSOR_DATA = object()  # a quality of service
_current: list[Graph] = []


def _graph() -> Graph:
    return _current[-1]


def _switch(is_up: bool) -> None:
    _graph().is_up = is_up


def _modules() -> dict[str, ModuleType]:
    """Return modules with what the node imports, by name."""
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda: _switch(True), "try_shutdown": lambda: _switch(False)},
        "rclpy.node": {"Node": Node},
        "rclpy.executors": {"MultiThreadedExecutor": MultiThreadedExecutor},
        "rclpy.callback_groups": {"MutuallyExclusiveCallbackGroup": MutuallyExclusiveCallbackGroup},
        "rclpy.qos": {"qos_profile_sensor_data": _SENSOR_DATA},
    }
    for name in _MESSAGES:
        package, kind = name.split("/")
        contents.setdefault(package, {})
        contents.setdefault(f"{package}.msg", {})[kind] = message_class(f"{package}/msg/{kind}")
    made = {name: ModuleType(name) for name in contents}
    for name, content in contents.items():
        made[name].__dict__.update(content)
    return made


@contextmanager
def ros2(graph: Graph) -> Iterator[None]:
    """Let modules be imported that need ROS 2."""
    made = _modules()
    _current.append(graph)
    before = {name: sys.modules.get(name) for name in made}
    sys.modules.update(made)
    try:
        yield
    finally:
        _current.pop()
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
