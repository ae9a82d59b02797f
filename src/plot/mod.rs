//! Pictures of graphs, schedules, supergraphs and delays: figures that a page or a single SVG holds.

pub(crate) mod delays;
pub(crate) mod graph;
pub(crate) mod identified;
pub(crate) mod latency;
mod layers;
pub(crate) mod schedule;
pub(crate) mod supergraph;

use std::path::Path;

use anyhow::Context;
use parallax_gap::plot::draw::{self, Anchor, Pen, escape};
use parallax_gap::plot::format::wrap;
use parallax_gap::plot::page;

use crate::cli::args::make_parent;
use crate::cli::failure::Failure;

/// Width of a drawing on a wide page, px.
pub(crate) const WIDE: f64 = 1040.0;
/// Width of a drawing on a narrow page, px.
pub(crate) const NARROW: f64 = 360.0;

/// A drawing that knows how high it became.
pub(crate) struct Drawing {
    pub(crate) pen: Pen,
    pub(crate) height: f64,
}

/// One figure, drawn twice: for wide pages and for narrow ones.
pub(crate) struct Figure {
    pub(crate) title: String,
    /// What is to be seen, in a sentence or two.
    pub(crate) note: String,
    pub(crate) wide: Drawing,
    pub(crate) narrow: Drawing,
}

/// A page, or a single SVG when the file's name ends so.
pub(crate) fn write(path: &Path, title: &str, lead: &str, figures: Vec<Figure>) -> Result<(), Failure> {
    let picture = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("svg"));
    let text = if picture { picture_of(title, lead, figures) } else { page_of(title, lead, figures) };
    make_parent(path)?;
    std::fs::write(path, text)
        .with_context(|| format!("{} cannot be written", path.display()))
        .map_err(Failure::input)
}

fn page_of(title: &str, lead: &str, figures: Vec<Figure>) -> String {
    let mut body =
        format!("<header>\n<h1>{}</h1>\n<p class=\"note\">{}</p>\n</header>\n", escape(title), escape(lead));
    for Figure { title, note, wide, narrow } in figures {
        body.push_str(&format!(
            "<section>\n<h2>{}</h2>\n<p class=\"note\">{}</p>\n<figure>\n{}{}</figure>\n</section>\n",
            escape(&title),
            escape(&note),
            wide.pen.finish("plot wide", WIDE, wide.height, &title),
            narrow.pen.finish("plot narrow", NARROW, narrow.height, &title),
        ));
    }
    page::write(title, &body, "")
}

fn picture_of(title: &str, lead: &str, figures: Vec<Figure>) -> String {
    let margin = 24.0;
    let mut pen = Pen::default();
    let mut y = 54.0;
    for Figure { title, note, wide, .. } in figures {
        y += 38.0;
        pen.text("head", (margin, y), Anchor::Start, &title);
        for line in wrap(&note, 165) {
            y += 16.0;
            pen.text("small", (margin, y), Anchor::Start, &line);
        }
        y += 12.0;
        pen.raw(&format!("<g transform=\"translate({margin} {})\">", draw::px(y)));
        pen.raw(&wide.pen.finish("plot", WIDE, wide.height, &title));
        pen.raw("</g>");
        y += wide.height;
    }
    // The paper lies below everything, and how high it is shows only now.
    let size = (WIDE + 2.0 * margin, y + 24.0);
    let mut sheet = Pen::default();
    sheet.raw(&format!("<style>{}</style>", draw::style_on_paper()));
    sheet.rect("paper", (0.0, 0.0), size);
    sheet.text("title", (margin, 34.0), Anchor::Start, title);
    sheet.text("soft", (margin, 54.0), Anchor::Start, lead);
    sheet.raw(&pen.into_elements());
    sheet.finish("figure", size.0, size.1, title)
}
