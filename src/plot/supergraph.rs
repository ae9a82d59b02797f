//! A supergraph: its slots by generation, in the order in which they run.

use parallax_runtime::graph::Graph;
use parallax_sim::supergraph::Supergraph;

use super::layers::{self, Edge, Sizes, Vertex};
use super::{Figure, NARROW, WIDE};

/// More slots than this are no picture any more.
const MOST: usize = 300;
/// More generations than this do not fit beside each other.
const BESIDE: usize = 14;

/// Draws the slots; `about` says how they were found and how well they are filled. `None` where there are too many.
pub(crate) fn figure(graph: &Graph, found: &Supergraph, about: &str) -> Option<Figure> {
    if found.labels.len() > MOST || found.labels.is_empty() {
        return None;
    }
    let mut layer = vec![0; found.labels.len()];
    for (index, slots) in found.generations.iter().enumerate() {
        for &slot in slots {
            layer[slot as usize] = index;
        }
    }
    let vertices: Vec<Vertex> = found
        .labels
        .iter()
        .zip(&layer)
        .map(|(&label, &layer)| Vertex {
            layer,
            name: graph.nodes()[label as usize].name.clone(),
            note: String::new(),
            lead: label as usize == graph.supervisor(),
        })
        .collect();
    let edges: Vec<Edge> = reduced(found)
        .into_iter()
        .map(|(from, to)| Edge { from: from as usize, to: to as usize, class: "link" })
        .collect();
    let draw = |width: f64, downwards: bool| {
        layers::draw(&vertices, &edges, Sizes { width, vertex: (104.0, 26.0), downwards })
    };
    Some(Figure {
        title: "Supergraph".into(),
        note: format!(
            "Each box is a slot for one step of a node, each {} a generation, whose slots may run at the same time. {about}",
            if found.generations.len() > BESIDE { "row" } else { "column (on narrow pages, row)" }
        ),
        wide: draw(WIDE, found.generations.len() > BESIDE),
        narrow: draw(NARROW, true),
    })
}

/// The edges that do not follow from others.
fn reduced(found: &Supergraph) -> Vec<(u32, u32)> {
    let count = found.labels.len();
    // Slots are in an order in which edges lead forward, so those behind a slot are known before it is looked at.
    let mut after: Vec<Vec<bool>> = vec![vec![false; count]; count];
    let mut kept = Vec::new();
    for from in (0..count).rev() {
        let mut next: Vec<usize> = found
            .edges
            .iter()
            .filter(|(tail, _)| *tail as usize == from)
            .map(|(_, head)| *head as usize)
            .collect();
        next.sort_unstable();
        let mut reached = vec![false; count];
        for head in next {
            if !reached[head] {
                kept.push((from as u32, head as u32));
                reached[head] = true;
                for (reached, after) in reached.iter_mut().zip(&after[head]) {
                    *reached |= after;
                }
            }
        }
        after[from] = reached;
    }
    kept.reverse();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_that_follow_from_others_are_not_drawn() {
        let found = Supergraph {
            labels: vec![0, 1, 0, 2],
            edges: vec![(0, 1), (0, 2), (0, 3), (1, 3), (2, 3)],
            ..Supergraph::default()
        };
        assert_eq!(reduced(&found), [(0, 2), (0, 1), (1, 3), (2, 3)].map(|(a, b)| (a, b)));
    }
}
