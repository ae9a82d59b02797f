"""A graph from nodes that Python wrote down: what stands in its `graph.toml`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from . import _native
from .member import Member, Node, PlainNode, RustNode
from .stepping import Began, began, initial_of, node_key
from .structure import Structure
from .types import Tree

__all__ = ["all_nodes", "assembled", "beginnings"]


def all_nodes(supervisor: Member, nodes: Sequence[Member] | None) -> dict[str, Member]:
    """The nodes by name, the supervisor among them; raises `ValueError` when a sender is missing or a name is taken."""
    listed = list(nodes or [])
    if not any(node is supervisor for node in listed):
        listed.insert(0, supervisor)
    found: dict[str, Member] = {}
    for node in listed:
        if not isinstance(node, Member):
            raise TypeError(f"{node!r} is no node: a graph is made of Node, PlainNode and RustNode")
        if node.name in found:
            raise ValueError(
                f"two nodes are called {node.name}; give one another name: {type(node).__name__}(name=...)"
            )
        found[node.name] = node
    for node in listed:
        for connection in node.connections:
            if found.get(connection.sender.name) is not connection.sender:
                raise ValueError(
                    f"node {node.name} is fed by {connection.sender.name}, which is not among the nodes of the graph: "
                    f"{', '.join(found)}"
                )
    return found


def beginnings(nodes: Mapping[str, Member], seed: int) -> dict[str, Began]:
    """What the nodes that are written in JAX begin with in a run of this seed."""
    return {name: began(node, node_key(seed, name)) for name, node in nodes.items() if isinstance(node, Node)}


def assembled(
    supervisor: Member, nodes: Mapping[str, Member], name: str, start: Mapping[str, Began]
) -> tuple[dict[str, Any], dict[str, str]]:
    """The graph as a `graph.toml` has it, and why other processes cannot make the nodes that they cannot make."""
    outputs: dict[str, Tree] = {}
    for node in nodes.values():
        output = _output(node, start.get(node.name))
        if output is not None:
            outputs[node.name] = output
    structures = {node: _structure(node, output) for node, output in outputs.items()}
    homeless: dict[str, str] = {}
    specs = []
    for node in nodes.values():
        spec = node.graph_spec()
        if not isinstance(node, RustNode):
            try:
                spec["parameters"] = node.graph_place()
            except TypeError as error:
                homeless[node.name] = str(error)
            structure = structures.get(node.name)
            spec["parameters"] |= _messages(node, nodes, structure, outputs.get(node.name))
            sees = {
                connection.port: structures[connection.sender.name].json()
                for connection in node.connections
                if connection.sender.name in structures and not structures[connection.sender.name].is_plain
            }
            spec["parameters"] |= {"sees": sees} if sees else {}
        specs.append(spec)
    connections = [connection.json(node.name) for node in nodes.values() for connection in node.connections]
    return {"name": name, "supervisor": supervisor.name, "node": specs, "connection": connections}, homeless


def _output(node: Member, start: Began | None) -> Tree:
    """What receivers see before its first message; `None` for a node of Rust, and where the node does not say."""
    if isinstance(node, Node):
        return start.output if start is not None else None
    if isinstance(node, PlainNode) and type(node).init_output is not PlainNode.init_output:
        return node.init_output()
    return None


def _structure(node: str, output: Tree) -> Structure:
    try:
        return Structure.of(output)
    except TypeError as error:
        raise TypeError(f"the init_output of node {node}: {error}") from None


def _messages(node: Member, nodes: Mapping[str, Member], structure: Structure | None, output: Tree) -> dict[str, Any]:
    """What the parameters of a node in Python say of its messages."""
    expected = _expected(node, nodes)
    if structure is None:
        if expected is None:
            raise NotImplementedError(
                f"{type(node).__name__} (node {node.name}) needs a method init_output: nothing else says what it sends"
            )
        return {}
    made: dict[str, Any] = {}
    if expected is None:
        message = {"message": f"python/{type(node).__name__}", "leaves": structure.names}
        made["output"] = message | (
            {"data": node.data_bytes} if isinstance(node, PlainNode) and node.data_bytes else {}
        )
    else:
        receiver, message_name, leaves = expected
        if set(leaves) != set(structure.names):
            raise ValueError(
                f"node {node.name} sends {', '.join(structure.names)}, and node {receiver} takes {message_name}: "
                f"{', '.join(leaves)}"
            )
    if not structure.is_plain:
        made["tree"] = structure.json()
    initial = initial_of(output)
    return made | ({"initial": initial} if initial else {})


def _expected(node: Member, nodes: Mapping[str, Member]) -> tuple[str, str, list[str]] | None:
    """What a receiver in Rust takes of it: the receiver, the message and its leaves."""
    known = _native.kinds()
    for receiver in nodes.values():
        if not isinstance(receiver, RustNode):
            continue
        for connection in receiver.connections:
            takes = known.get(receiver.kind, {"inputs": {}})["inputs"].get(connection.port)
            if connection.sender is node and takes is not None:
                return receiver.name, takes[0], list(takes[1])
    return None
