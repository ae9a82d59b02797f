//! Directed graphs drawn in layers: every vertex in the layer that it was given, edges from layer to layer, few crossings
//! (Sugiyama, Tagawa and Toda 1981: places on the way of long edges, and sweeps that order each layer by the means of its
//! neighbours' places).

use parallax_gap::plot::draw::{Anchor, Pen, px};
use parallax_gap::plot::format::clip;

use super::Drawing;

/// A vertex of a drawing.
pub(super) struct Vertex {
    /// The layer, from 0.
    pub(super) layer: usize,
    /// What is written on it: a name, and a line below it.
    pub(super) name: String,
    pub(super) note: String,
    /// Whether it is to stand out.
    pub(super) lead: bool,
}

/// An edge of a drawing; its class is its style.
pub(super) struct Edge {
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) class: &'static str,
}

/// Sizes of a drawing, px.
#[derive(Clone, Copy)]
pub(super) struct Sizes {
    /// Width of the whole.
    pub(super) width: f64,
    /// The largest size of a vertex.
    pub(super) vertex: (f64, f64),
    /// Whether layers follow each other downwards instead of to the right.
    pub(super) downwards: bool,
}

/// Sweeps over the layers; the order hardly changes after a few.
const SWEEPS: usize = 8;

/// A vertex, or the place where a long edge passes a layer.
#[derive(Clone, Copy, PartialEq)]
enum Item {
    Vertex(usize),
    Passage,
}

struct Layout {
    items: Vec<Item>,
    layers: Vec<Vec<usize>>,
    /// Items along each edge, ends included; none for an edge that leads back.
    routes: Vec<Vec<usize>>,
    /// Place of each item within its layer, from 0 to 1.
    place: Vec<f64>,
}

fn lay_out(vertices: &[Vertex], edges: &[Edge]) -> Layout {
    let count = vertices.iter().map(|vertex| vertex.layer + 1).max().unwrap_or(1);
    let mut items: Vec<Item> = (0..vertices.len()).map(Item::Vertex).collect();
    let mut layers: Vec<Vec<usize>> = vec![Vec::new(); count];
    for (index, vertex) in vertices.iter().enumerate() {
        layers[vertex.layer].push(index);
    }
    let mut routes = Vec::with_capacity(edges.len());
    for edge in edges {
        let (from, to) = (vertices[edge.from].layer, vertices[edge.to].layer);
        let mut route = Vec::new();
        if from < to {
            route.push(edge.from);
            for layer in &mut layers[from + 1..to] {
                layer.push(items.len());
                route.push(items.len());
                items.push(Item::Passage);
            }
            route.push(edge.to);
        }
        routes.push(route);
    }
    let mut neighbours: Vec<[Vec<usize>; 2]> = vec![Default::default(); items.len()];
    for pair in routes.iter().flat_map(|route| route.windows(2)) {
        neighbours[pair[1]][0].push(pair[0]);
        neighbours[pair[0]][1].push(pair[1]);
    }
    let mut place = vec![0.0; items.len()];
    let spread = |layer: &[usize], place: &mut [f64]| {
        for (index, &item) in layer.iter().enumerate() {
            place[item] = (index as f64 + 0.5) / layer.len() as f64;
        }
    };
    for layer in &layers {
        spread(layer, &mut place);
    }
    for sweep in 0..SWEEPS {
        let side = sweep % 2;
        let order: Vec<usize> = if side == 0 { (0..count).collect() } else { (0..count).rev().collect() };
        for index in order {
            let mean = |item: usize| {
                let near = &neighbours[item][side];
                if near.is_empty() {
                    place[item]
                } else {
                    near.iter().map(|&other| place[other]).sum::<f64>() / near.len() as f64
                }
            };
            let mut keyed: Vec<(f64, usize)> = layers[index].iter().map(|&item| (mean(item), item)).collect();
            keyed.sort_by(|a, b| a.0.total_cmp(&b.0));
            layers[index] = keyed.into_iter().map(|(_, item)| item).collect();
            spread(&layers[index], &mut place);
        }
    }
    Layout { items, layers, routes, place }
}

/// Draws vertices and edges. Edges that do not lead forward run around the outside.
pub(super) fn draw(vertices: &[Vertex], edges: &[Edge], sizes: Sizes) -> Drawing {
    let layout = lay_out(vertices, edges);
    let widest = layout.layers.iter().map(Vec::len).max().unwrap_or(1).max(1) as f64;
    let count = layout.layers.len() as f64;
    let back: Vec<usize> = (0..edges.len()).filter(|&index| layout.routes[index].is_empty()).collect();
    // Many lines around the outside move together.
    let pitch = 11.0_f64.min(0.25 * sizes.width / back.len().max(1) as f64);
    let around = 14.0 + pitch * back.len() as f64;
    // Along the layers, and across them.
    let (along, across, outer) = if sizes.downwards {
        let rows = sizes.vertex.1 + 34.0;
        (rows, (sizes.width - around) / widest, sizes.width - around)
    } else {
        let rows = sizes.vertex.1 + 22.0;
        (sizes.width / count, rows, rows * widest)
    };
    let size = if sizes.downwards {
        (sizes.vertex.0.min((across - 10.0).max(0.6 * across)), sizes.vertex.1)
    } else {
        (sizes.vertex.0.min(along * 0.7), sizes.vertex.1)
    };
    let layer_of = {
        let mut layer_of = vec![0; layout.items.len()];
        for (layer, items) in layout.layers.iter().enumerate() {
            for &item in items {
                layer_of[item] = layer;
            }
        }
        layer_of
    };
    let centre = |item: usize| {
        let forward = along * (layer_of[item] as f64 + 0.5);
        let sideways = outer * layout.place[item];
        if sizes.downwards { (sideways, forward) } else { (forward, sideways) }
    };
    let mut pen = Pen::default();
    for (index, edge) in edges.iter().enumerate() {
        let route = &layout.routes[index];
        if route.is_empty() {
            continue;
        }
        let last = route.len() - 1;
        let points: Vec<(f64, f64)> = route
            .iter()
            .enumerate()
            .flat_map(|(place, &item)| {
                let (x, y) = centre(item);
                let half = if layout.items[item] == Item::Passage {
                    0.25 * along.min(60.0)
                } else if sizes.downwards {
                    0.5 * size.1
                } else {
                    0.5 * size.0
                };
                let (before, after) = if sizes.downwards {
                    ((x, y - half), (x, y + half))
                } else {
                    ((x - half, y), (x + half, y))
                };
                match place {
                    0 => vec![after],
                    place if place == last => vec![before],
                    _ => vec![before, after],
                }
            })
            .collect();
        curve(&mut pen, edge.class, &points, sizes.downwards);
    }
    for (number, &index) in back.iter().enumerate() {
        let edge = &edges[index];
        let lane = outer + 10.0 + pitch * number as f64;
        let side = if sizes.downwards { size.1 } else { size.0 };
        let apart = 5.0_f64.min(0.8 * side / back.len() as f64);
        let spread = apart * (number as f64 - 0.5 * (back.len() as f64 - 1.0));
        let ends = [centre(edge.from), centre(edge.to)];
        loop_around(&mut pen, edge.class, ends, lane, spread, size, sizes.downwards);
    }
    for (index, vertex) in vertices.iter().enumerate() {
        let (x, y) = centre(index);
        let class = if vertex.lead { "vertex-lead" } else { "vertex" };
        pen.rect(class, (x - 0.5 * size.0, y - 0.5 * size.1), size);
        let letters = ((size.0 - 4.0) / 6.6).max(1.0) as usize;
        let middle = if vertex.note.is_empty() { y + 4.0 } else { y - 2.0 };
        pen.text("plain", (x, middle), Anchor::Middle, &clip(&vertex.name, letters));
        if !vertex.note.is_empty() {
            pen.text("small", (x, y + 12.0), Anchor::Middle, &clip(&vertex.note, letters));
        }
    }
    let height =
        if sizes.downwards { along * count } else { outer + if back.is_empty() { 0.0 } else { around } };
    Drawing { pen, height: height + 6.0 }
}

/// A smooth line through points, straight between every second pair, with a tip at its end.
fn curve(pen: &mut Pen, class: &str, points: &[(f64, f64)], downwards: bool) {
    let mut path = format!("M{} {}", px(points[0].0), px(points[0].1));
    for pair in points.windows(2) {
        let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
        let ((a, b), (c, d)) = if downwards {
            ((x0, 0.5 * (y0 + y1)), (x1, 0.5 * (y0 + y1)))
        } else {
            ((0.5 * (x0 + x1), y0), (0.5 * (x0 + x1), y1))
        };
        path.push_str(&format!("C{} {} {} {} {} {}", px(a), px(b), px(c), px(d), px(x1), px(y1)));
    }
    pen.raw(&format!("<path class=\"{class}\" d=\"{path}\"/>"));
    let end = points[points.len() - 1];
    tip(pen, class, end, if downwards { (0.0, 1.0) } else { (1.0, 0.0) });
}

/// A line that leaves one vertex on the outside, runs along `lane` and comes back to another.
fn loop_around(
    pen: &mut Pen,
    class: &str,
    [from, to]: [(f64, f64); 2],
    lane: f64,
    spread: f64,
    size: (f64, f64),
    downwards: bool,
) {
    let corner = 8.0;
    let (path, end, direction) = if downwards {
        let (x0, y0) = (from.0 + 0.5 * size.0, from.1 + spread);
        let (x1, y1) = (to.0 + 0.5 * size.0, to.1 + spread);
        let turn = if y1 < y0 { -corner } else { corner };
        let path = format!(
            "M{} {}H{}Q{} {} {} {}V{}Q{} {} {} {}H{}",
            px(x0),
            px(y0),
            px(lane - corner),
            px(lane),
            px(y0),
            px(lane),
            px(y0 + turn),
            px(y1 - turn),
            px(lane),
            px(y1),
            px(lane - corner),
            px(y1),
            px(x1)
        );
        (path, (x1, y1), (-1.0, 0.0))
    } else {
        let (x0, y0) = (from.0 + spread, from.1 + 0.5 * size.1);
        let (x1, y1) = (to.0 + spread, to.1 + 0.5 * size.1);
        let turn = if x1 < x0 { -corner } else { corner };
        let path = format!(
            "M{} {}V{}Q{} {} {} {}H{}Q{} {} {} {}V{}",
            px(x0),
            px(y0),
            px(lane - corner),
            px(x0),
            px(lane),
            px(x0 + turn),
            px(lane),
            px(x1 - turn),
            px(x1),
            px(lane),
            px(x1),
            px(lane - corner),
            px(y1)
        );
        (path, (x1, y1), (0.0, -1.0))
    };
    pen.raw(&format!("<path class=\"{class}\" d=\"{path}\"/>"));
    tip(pen, class, end, direction);
}

/// An arrow's tip at `end`, pointing along `direction`.
fn tip(pen: &mut Pen, class: &str, (x, y): (f64, f64), (dx, dy): (f64, f64)) {
    let (back, half) = (6.0, 3.2);
    let at = |along: f64, aside: f64| (x - along * dx - aside * dy, y - along * dy + aside * dx);
    let (a, b) = (at(back, half), at(back, -half));
    pen.raw(&format!(
        "<path class=\"tip-{class}\" d=\"M{} {}L{} {}L{} {}Z\"/>",
        px(x),
        px(y),
        px(a.0),
        px(a.1),
        px(b.0),
        px(b.1)
    ));
}

/// The layer of every vertex: one behind the last of its predecessors along `edges`, which must not hold a cycle.
pub(super) fn longest_paths(order: &[usize], edges: &[(usize, usize)]) -> Vec<usize> {
    let mut layers = vec![0; order.len()];
    for &vertex in order {
        let before = edges.iter().filter(|(_, to)| *to == vertex).map(|(from, _)| layers[*from] + 1);
        layers[vertex] = before.max().unwrap_or(0);
    }
    layers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_receiver_lies_behind_its_senders() {
        assert_eq!(longest_paths(&[2, 0, 1, 3], &[(2, 0), (0, 1), (2, 1), (1, 3)]), [1, 2, 0, 3]);
    }

    #[test]
    fn two_chains_do_not_cross() {
        // Declared crosswise: the sweeps have to find it.
        let vertex = |layer: usize| Vertex { layer, name: "v".into(), note: String::new(), lead: false };
        let vertices: Vec<Vertex> = [0, 0, 1, 1, 2, 2].map(vertex).into();
        let edge = |(from, to): (usize, usize)| Edge { from, to, class: "link" };
        let edges: Vec<Edge> = [(0, 3), (1, 2), (3, 4), (2, 5)].map(edge).into();
        let place = lay_out(&vertices, &edges).place;
        assert_eq!(place[0] < place[1], place[3] < place[2]);
        assert_eq!(place[3] < place[2], place[4] < place[5]);
    }

    #[test]
    fn large_graphs_stay_within_the_page() {
        let vertices: Vec<Vertex> = (0..200)
            .map(|index| Vertex {
                layer: index / 25,
                name: format!("node_{index}"),
                note: "100 Hz".into(),
                lead: index == 199,
            })
            .collect();
        // Edges of every kind: one layer on, several layers on, back, and to itself.
        let edges: Vec<Edge> =
            (0..1000).map(|k| Edge { from: k * 7 % 200, to: k * k % 200, class: "latest" }).collect();
        for downwards in [false, true] {
            let sizes = Sizes { width: 1040.0, vertex: (130.0, 38.0), downwards };
            let drawing = draw(&vertices, &edges, sizes);
            assert!(drawing.height.is_finite());
            let svg = drawing.pen.finish("plot", 1040.0, drawing.height, "large");
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "a coordinate is no number");
            for x in svg.split(" x=\"").skip(1).filter_map(|rest| rest.split('"').next()) {
                let x: f64 = x.parse().unwrap();
                assert!((-200.0..1040.0).contains(&x), "{x}");
            }
        }
    }
}
