//! A graph of nodes: who sends to whom, and who waits.

use parallax_gap::plot::draw::{Anchor, Pen};
use parallax_runtime::graph::{ConnectionPlan, Graph};

use super::layers::{self, Edge, Sizes, Vertex};
use super::{Drawing, Figure, NARROW, WIDE};

/// Draws the nodes in layers: a receiver behind its senders, connections with `skip` aside.
pub(crate) fn figure(graph: &Graph) -> Figure {
    let edges: Vec<(usize, usize)> =
        graph.connections().iter().filter(|plan| !plan.skip).map(|plan| (plan.from, plan.to)).collect();
    let places = layers::longest_paths(graph.order(), &edges);
    let rates = graph.spec().nodes.iter().map(|node| node.rate);
    let vertices: Vec<Vertex> = graph
        .nodes()
        .iter()
        .zip(rates)
        .enumerate()
        .map(|(index, (node, rate))| Vertex {
            layer: places[index],
            name: node.name.clone(),
            note: format!("{rate} Hz"),
            lead: index == graph.supervisor(),
        })
        .collect();
    let edges: Vec<Edge> = graph
        .connections()
        .iter()
        .map(|plan| Edge { from: plan.from, to: plan.to, class: class(plan) })
        .collect();
    let draw = |width: f64, size: (f64, f64), downwards: bool| {
        let drawing = layers::draw(&vertices, &edges, Sizes { width, vertex: size, downwards });
        with_legend(drawing, width)
    };
    Figure {
        title: "Nodes and connections".into(),
        note: "Framed: the supervisor, at whose rate the graph is stepped.".into(),
        wide: draw(WIDE, (132.0, 38.0), false),
        narrow: draw(NARROW, (112.0, 38.0), true),
    }
}

/// The style of a connection.
pub(super) fn class(plan: &ConnectionPlan) -> &'static str {
    match plan {
        plan if plan.skip => "skip",
        plan if plan.blocking => "blocking",
        _ => "latest",
    }
}

/// What the lines mean, below a drawing.
pub(super) fn with_legend(mut drawing: Drawing, width: f64) -> Drawing {
    let y = drawing.height + 14.0;
    let narrow = width < 500.0;
    let gap = if narrow { 116.0 } else { 150.0 };
    for (index, (class, text)) in [
        ("blocking", "waits for it"),
        ("latest", "takes the latest"),
        ("skip", if narrow { "skips" } else { "skips what comes just then" }),
    ]
    .into_iter()
    .enumerate()
    {
        let x = gap * index as f64;
        legend_line(&mut drawing.pen, class, (x, y), text);
    }
    drawing.height = y + 10.0;
    drawing
}

fn legend_line(pen: &mut Pen, class: &str, (x, y): (f64, f64), text: &str) {
    pen.line(class, (x, y - 4.0), (x + 20.0, y - 4.0));
    pen.text("small", (x + 25.0, y), Anchor::Start, text);
}
