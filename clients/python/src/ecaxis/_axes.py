"""What all machines have in common: their axes by name, and what is read from a state."""

from __future__ import annotations

from typing import Any, Dict, Generic, Mapping, TypeVar

A = TypeVar("A")


class AxesByName(Generic[A]):
    """Axes as attributes and items."""

    axes: Dict[str, A]

    def __getattr__(self, name: str) -> A:
        axes: Dict[str, A] = self.__dict__.get("axes", {})
        if name in axes:
            return axes[name]
        raise AttributeError(f"the machine has no axis `{name}`; it has {', '.join(axes) or 'none'}")

    def __getitem__(self, name: str) -> A:
        return self.axes[name]


class AxisOf:
    """The description of an axis in the object `machine`."""

    def __init__(self, about: Mapping[str, Any]) -> None:
        self.about = dict(about)
        self.name = str(about["name"])
        self.unit = str(about.get("unit") or "")

    def __repr__(self) -> str:
        return f"<axis {self.name} in {self.unit}>"

    def of_state(self, state: Mapping[str, Any]) -> Dict[str, Any]:
        """Returns the object of this axis in the state of a machine."""
        return next(axis for axis in state["axes"] if axis["name"] == self.name)


def input_of(state: Mapping[str, Any], device: str, name: str) -> float:
    """Returns an input from the state of a machine."""
    for signal in state["inputs"]:
        if (signal["device"], signal["name"]) == (device, name):
            return float(signal["value"])
    raise KeyError(f"the machine has no input `{name}` of `{device}`")
