//! Marks on paper: SVG elements with their text escaped, and the colours of the page.

/// Colours by name: on paper, and on a dark screen. The two predictions differ in lightness, dash and weight too
/// (vermilion and blue of Okabe and Ito's palette, darkened or lightened until they can be read as text).
pub const COLOURS: [(&str, &str, &str); 10] = [
    ("paper", "#ffffff", "#15181c"),
    ("panel", "#f6f7f9", "#1c2026"),
    ("ink", "#1b1f24", "#e9ebee"),
    ("soft", "#59626d", "#a7b0bb"),
    ("rule", "#d5dae0", "#363d46"),
    ("band", "#e9edf2", "#262c34"),
    ("measured", "#98a2ae", "#7c8692"),
    ("before", "#b8420b", "#ff9c5f"),
    ("after", "#0a5fae", "#6db7ff"),
    ("bar", "#5f93c4", "#4f86b8"),
];

/// Style of all plots, in terms of the colours.
pub const STYLE: &str = include_str!("plot.css");

/// The style with the colours of paper written out, for an SVG that stands alone: not every viewer knows variables.
pub fn style_on_paper() -> String {
    COLOURS
        .iter()
        .fold(STYLE.to_owned(), |style, (name, light, _)| style.replace(&format!("var(--{name})"), light))
}

/// Text as it may stand in HTML and XML, in quotes too. Characters that XML cannot hold become U+FFFD.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            '\t' | '\n' | '\r' => escaped.push(c),
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => escaped.push('\u{fffd}'),
            c => escaped.push(c),
        }
    }
    escaped
}

/// Sets a number: a true minus sign, spaces that do not break before units.
pub fn typeset(number: &str) -> String {
    number.replace('-', "−").replace(' ', "\u{a0}")
}

/// A coordinate to a tenth of a pixel.
pub fn px(value: f64) -> String {
    let text = format!("{value:.1}");
    let text = text.strip_suffix(".0").unwrap_or(&text);
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

/// Which end of a text lies at its position.
#[derive(Debug, Clone, Copy)]
pub enum Anchor {
    /// Its left end.
    Start,
    /// Its middle.
    Middle,
    /// Its right end.
    End,
}

/// An SVG being drawn.
#[derive(Debug, Default)]
pub struct Pen {
    elements: String,
}

impl Pen {
    /// The element `<svg>` with everything drawn so far, so large in pixels; `label` says what it shows to whoever cannot see it.
    pub fn finish(self, class: &str, width: f64, height: f64, label: &str) -> String {
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"{class}\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" \
             height=\"{h}\" role=\"img\" aria-label=\"{label}\">{elements}</svg>\n",
            w = px(width),
            h = px(height),
            label = escape(label),
            elements = self.elements,
        )
    }

    /// Everything drawn so far, for another drawing to hold.
    pub fn into_elements(self) -> String {
        self.elements
    }

    /// An element as it is written. What it holds must be escaped.
    pub fn raw(&mut self, element: &str) {
        self.elements.push_str(element);
    }

    /// A line.
    pub fn line(&mut self, class: &str, from: (f64, f64), to: (f64, f64)) {
        self.raw(&format!(
            "<line class=\"{class}\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>",
            px(from.0),
            px(from.1),
            px(to.0),
            px(to.1)
        ));
    }

    /// A rectangle, from its upper left corner.
    pub fn rect(&mut self, class: &str, corner: (f64, f64), size: (f64, f64)) {
        self.raw(&format!(
            "<rect class=\"{class}\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"/>",
            px(corner.0),
            px(corner.1),
            px(size.0.max(0.0)),
            px(size.1.max(0.0))
        ));
    }

    /// A disc.
    pub fn dot(&mut self, class: &str, at: (f64, f64), radius: f64) {
        self.raw(&format!(
            "<circle class=\"{class}\" cx=\"{}\" cy=\"{}\" r=\"{}\"/>",
            px(at.0),
            px(at.1),
            px(radius)
        ));
    }

    /// A text, which is escaped.
    pub fn text(&mut self, class: &str, at: (f64, f64), anchor: Anchor, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        self.raw(&format!(
            "<text class=\"{class}\" x=\"{}\" y=\"{}\" text-anchor=\"{anchor}\">{}</text>",
            px(at.0),
            px(at.1),
            escape(text)
        ));
    }

    /// A text in the middle of its position, or ending at `edge` where it would reach beyond it; it is escaped.
    pub fn text_within(&mut self, class: &str, at: (f64, f64), edge: f64, text: &str) {
        // What a text is wide is a guess: within a pixel of the edge it may be beyond.
        if at.0 + 0.5 * width(text, 11.0) > edge - 1.0 {
            self.text(class, (edge, at.1), Anchor::End, text);
        } else {
            self.text(class, at, Anchor::Middle, text);
        }
    }

    /// Lines through points; a run of one point becomes a dot as wide as the line.
    pub fn runs(&mut self, class: &str, runs: &[Vec<(f64, f64)>]) {
        let mut path = String::new();
        for run in runs {
            for (i, (x, y)) in run.iter().enumerate() {
                path.push_str(if i == 0 { "M" } else { " " });
                path.push_str(&format!("{} {}", px(*x), px(*y)));
            }
            if run.len() == 1 {
                path.push_str("h0");
            }
        }
        if !path.is_empty() {
            self.raw(&format!("<path class=\"{class}\" d=\"{path}\"/>"));
        }
    }
}

/// Width of a text in pixels, roughly: fonts differ, and an SVG cannot ask.
pub fn width(text: &str, size: f64) -> f64 {
    text.chars().count() as f64 * size * 0.56
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_escaped() {
        assert_eq!(escape("a<b> & \"c\" 'd'\u{0}"), "a&lt;b&gt; &amp; &quot;c&quot; &#39;d&#39;\u{fffd}");
    }

    #[test]
    fn a_text_ends_at_the_edge() {
        let drawn = |x: f64| {
            let mut pen = Pen::default();
            pen.text_within("tick", (x, 5.0), 100.0, "3.0");
            pen.into_elements()
        };
        assert_eq!(drawn(50.0), "<text class=\"tick\" x=\"50\" y=\"5\" text-anchor=\"middle\">3.0</text>");
        assert_eq!(drawn(97.0), "<text class=\"tick\" x=\"100\" y=\"5\" text-anchor=\"end\">3.0</text>");
    }

    #[test]
    fn coordinates_are_short() {
        assert_eq!((px(1.0), px(-0.01), px(2.345)), ("1".into(), "0".into(), "2.3".into()));
    }

    #[test]
    fn the_style_on_paper_needs_no_variables() {
        assert!(!style_on_paper().contains("var("), "a colour has no name in the list");
    }
}
