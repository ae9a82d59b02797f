"""Times the peer `supergraph` (PyPI) on the episodes that ours were timed on.

    cargo bench -p parallax-sim --bench supergraph -- --dump episodes.json
    python benches/peers/supergraph_peer.py episodes.json [number of episodes]

The peer gets the computation graph of each episode, once as it is (it then cuts the episode itself) and once with an
edge from every step of the supervisor to all of the next partition, which holds it to the partitions of the file.
"""

import json
import sys
import time

import networkx as nx
import supergraph


def graph(episode, supervisor, held):
    """The episode as the peer wants it: vertices `NODE_SEQ` with their kind; a fixed cut if `held`."""
    found = nx.DiGraph()
    names = [f"{node}_{seq}" for node, seq, _, _ in episode["steps"]]
    for name, (node, seq, start, _) in zip(names, episode["steps"], strict=True):
        found.add_node(name, kind=node, seq=seq, ts=start, order=node)
    found.add_edges_from(((names[a], names[b]) for a, b in episode["edges"]), **supergraph.EDGE_DATA)
    if held:
        ends = {step[3]: name for name, step in zip(names, episode["steps"], strict=True) if step[0] == supervisor}
        for name, step in zip(names, episode["steps"], strict=True):
            if step[3] - 1 in ends:
                found.add_edge(ends[step[3] - 1], name, **supergraph.EDGE_DATA)
    return found


def main():
    with open(sys.argv[1]) as file:
        data = json.load(file)
    supervisor = data["supervisor"]
    episodes = data["episodes"][: int(sys.argv[2]) if len(sys.argv) > 2 else None]
    partitions = sum(step[0] == supervisor for episode in episodes for step in episode["steps"])
    vertices = sum(len(episode["steps"]) for episode in episodes)
    print(f"{len(episodes)} episodes, {partitions} partitions, {vertices} steps")
    for held, title in [(False, "peer, its own cut"), (True, "peer, the partitions of the file")]:
        graphs = [graph(episode, supervisor, held) for episode in episodes]
        begin = time.perf_counter()
        found, _, _ = supergraph.grow_supergraph(graphs, supervisor, backtrack=20, progress_bar=False)
        seconds = time.perf_counter() - begin
        efficiency = vertices / (len(found) * partitions)
        print(f"{title}: {seconds:.2f} s, {len(found)} slots, efficiency {100 * efficiency:.1f} %", flush=True)


if __name__ == "__main__":
    main()
