//! A self-contained page: HTML that is well-formed XML too, with its styles, plots and script inside.

use super::draw::{self, escape};

/// Writes a page. `body` is HTML, `script` JavaScript. It asks the network for nothing; light or dark as the reader's
/// system is, and black on white in print.
pub fn write(title: &str, body: &str, script: &str) -> String {
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <meta name=\"color-scheme\" content=\"light dark\"/>\n<title>{title}</title>\n\
         <style>\n{colours}{page}{plot}</style>\n</head>\n<body>\n<main>\n{body}</main>\n\
         <script>\n{script}</script>\n</body>\n</html>\n",
        title = escape(title),
        colours = colours(),
        page = include_str!("page.css"),
        plot = draw::STYLE,
    )
}

/// The colours as variables, for light and dark screens; print is always light.
fn colours() -> String {
    let list = |pick: fn(&(&str, &str, &str)) -> String| draw::COLOURS.iter().map(pick).collect::<String>();
    let light = list(|(name, light, _)| format!("--{name}:{light};"));
    let dark = list(|(name, _, dark)| format!("--{name}:{dark};"));
    format!(":root{{{light}}}\n@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}\n")
}

/// So many names are listed where there are more than twice as many.
const NAMED: usize = 12;

/// Names that follow `lead`, separated by `between`. A machine with many sensors has hundreds: of those a few are shown,
/// and the others when somebody asks.
pub(crate) fn listed(lead: &str, names: &[String], between: &str) -> String {
    let shown = if names.len() > 2 * NAMED { NAMED } else { names.len() };
    let (first, rest) = names.split_at(shown);
    let first = first.join(between);
    if rest.is_empty() {
        return format!("<p class=\"note\">{lead}: {first}.</p>\n");
    }
    format!(
        "<p class=\"note\">{lead}: {first}{between}and {} more.</p>\n<details class=\"note\"><summary>Show them</summary>\
         <p class=\"note\">{}.</p></details>\n",
        rest.len(),
        rest.join(between)
    )
}
