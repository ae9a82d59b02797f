//! What commands print: tables for people, JSON for scripts, progress for whoever waits.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use super::failure::Failure;

/// Prints a line to standard output; a reader that has gone away is no error.
pub(crate) fn line(text: impl AsRef<str>) {
    let _ = writeln!(std::io::stdout(), "{}", text.as_ref());
}

/// Prints a value as JSON.
pub(crate) fn json(value: &impl Serialize) -> Result<(), Failure> {
    line(serde_json::to_string_pretty(value).map_err(Failure::runtime)?);
    Ok(())
}

/// Prints rows below a header, in columns as wide as they need. Numbers are set to the right.
pub(crate) fn table(header: &[&str], rows: &[Vec<String>]) {
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count());
        cells.chain([header[column].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..header.len()).map(width).collect();
    // Numbers stand below each other; a sentence that begins with one is none.
    let is_number = |cell: &str| {
        cell.starts_with(|c: char| c.is_ascii_digit() || c == '-') && cell.split_whitespace().count() < 3
    };
    let print = |cells: &mut dyn Iterator<Item = &str>| {
        let mut text = String::from(" ");
        for (cell, width) in cells.zip(&widths) {
            let pad = " ".repeat(width.saturating_sub(cell.chars().count()));
            text += &if is_number(cell) { format!(" {pad}{cell}") } else { format!(" {cell}{pad}") };
        }
        line(text.trim_end());
    };
    print(&mut header.iter().copied());
    for row in rows {
        print(&mut row.iter().map(String::as_str));
    }
}

/// How many columns the terminal has, `most` at most; `most` where standard output is none.
pub(crate) fn columns(most: usize) -> usize {
    let size = std::io::stdout().is_terminal().then(crossterm::terminal::size);
    size.and_then(Result::ok).map_or(most, |(columns, _)| usize::from(columns).clamp(40, most.max(40)))
}

/// Text whose lines are broken at spaces where they are longer than `columns`. What follows stands below the text that a
/// label or spaces begin, a little further in.
pub(crate) fn folded(text: &str, columns: usize) -> String {
    let mut lines = Vec::new();
    for line in text.lines() {
        let (mut rest, mut begin) = (line, String::new());
        while begin.chars().count() + rest.chars().count() > columns {
            let room = columns.saturating_sub(begin.chars().count());
            // A word that fits nowhere stays whole.
            let text = rest.len() - rest.trim_start().len();
            let within = rest.char_indices().take(room + 1).filter(|(at, c)| *c == ' ' && *at > text);
            let Some((at, _)) =
                within.last().or_else(|| rest.char_indices().find(|(at, c)| *c == ' ' && *at > text))
            else {
                break;
            };
            lines.push(format!("{begin}{}", rest[..at].trim_end()));
            rest = rest[at..].trim_start();
            begin = " ".repeat(hang(line).min(columns / 3));
        }
        lines.push(format!("{begin}{rest}"));
    }
    lines.join("\n")
}

/// Where what follows a line begins: below its text, two columns further in; at once where it is plain text.
fn hang(line: &str) -> usize {
    let spaces = |text: &str| text.chars().take_while(|c| *c == ' ').count();
    match (spaces(line), line.find("  ")) {
        (0, Some(end)) if end < 16 => end + spaces(&line[end..]) + 2,
        (0, _) => 0,
        (indent, _) => indent + 2,
    }
}

/// A number with five significant digits.
pub(crate) fn number(value: f64) -> String {
    let digits = 4.0 - value.abs().log10().floor();
    if value == 0.0 {
        "0".into()
    } else if (0.0..=9.0).contains(&digits) {
        format!("{value:.0$}", digits as usize)
    } else {
        format!("{value:.4e}")
    }
}

/// Seconds with a unit that fits.
pub(crate) fn seconds(value: f64) -> String {
    match value.abs() {
        0.0 => "0 s".into(),
        size if size < 1e-6 => format!("{:.0} ns", value * 1e9),
        size if size < 1e-3 => format!("{:.1} us", value * 1e6),
        size if size < 1.0 => format!("{:.2} ms", value * 1e3),
        _ => format!("{value:.3} s"),
    }
}

/// A bar on standard error that counts to `total`; hidden where that is no terminal.
pub(crate) fn progress(what: &str, total: u64) -> ProgressBar {
    let bar = ProgressBar::new(total);
    let style = ProgressStyle::with_template("{msg} [{wide_bar}] {percent}% {eta}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("=> "));
    bar.set_message(what.to_owned());
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

/// Work that takes minutes or hours, counted: a bar on a terminal, elsewhere a line a minute, so that a log shows how far it is.
pub(crate) struct Count {
    bar: ProgressBar,
    what: &'static str,
    total: u64,
    begun: Instant,
    done: AtomicU64,
    /// Minutes that were told.
    told: AtomicU64,
}

impl Count {
    /// Nothing done of `total`.
    pub(crate) fn new(what: &'static str, total: u64) -> Self {
        let zero = || AtomicU64::new(0);
        let bar = progress(what, total);
        Count { bar, what, total, begun: Instant::now(), done: zero(), told: zero() }
    }

    /// One more is done.
    pub(crate) fn one_more(&self) {
        self.bar.inc(1);
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let minutes = self.begun.elapsed().as_secs() / 60;
        if self.told.fetch_max(minutes, Ordering::Relaxed) < minutes && !std::io::stderr().is_terminal() {
            eprintln!("{}", so_far(self.what, done, self.total, self.begun.elapsed()));
        }
    }

    /// Takes the bar away.
    pub(crate) fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// How far work is, and how long the rest takes if it goes on like that.
fn so_far(what: &str, done: u64, total: u64, after: Duration) -> String {
    let left = after.as_secs_f64() * total.saturating_sub(done) as f64 / done.max(1) as f64;
    format!("{what}: {done} of {total}, {:.0} min left", (left / 60.0).ceil())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::{folded, so_far};

    #[test]
    fn work_so_far_says_what_is_left() {
        let said = so_far("making cases", 90, 540, Duration::from_secs(121));
        assert_eq!(said, "making cases: 90 of 540, 11 min left");
        assert_eq!(
            so_far("diagnosing", 540, 540, Duration::from_secs(9)),
            "diagnosing: 540 of 540, 0 min left"
        );
    }

    #[test]
    fn long_lines_go_on_below_their_text() {
        let text = "The gap lies at joint:shaft and nowhere else at all.\n\ngap      detected, and by far too long\n   \
                    which   one of these is quite long\nshort";
        let expected = "The gap lies at\njoint:shaft and\nnowhere else at\nall.\n\ngap      detected,\n      and by \
                        far\n      too long\n   which   one of\n     these is\n     quite long\nshort";
        assert_eq!(folded(text, 18), expected);
        assert_eq!(folded("unbreakable-as-it-is and more", 10), "unbreakable-as-it-is\nand more");
        assert_eq!(folded(text, 100), text);
    }
}
