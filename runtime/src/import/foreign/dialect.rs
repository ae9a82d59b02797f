//! How a text file of numbers is written: encoding, delimiter, decimal mark, where the header is.

use super::clock::is_date;
use super::header;
use super::units;

/// What is known of a CSV file beforehand. What is left open is found out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dialect {
    /// What separates the columns; a blank stands for any number of blanks.
    pub delimiter: Option<char>,
    /// Whether numbers have a comma where others have a point.
    pub decimal_comma: Option<bool>,
    /// The line of the columns' names, from 1; 0 when there is none.
    pub header: Option<usize>,
    /// Cells that stand for no value, beside the usual ones.
    pub missing: Vec<String>,
}

/// How a file is written.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Written {
    pub(super) delimiter: char,
    pub(super) decimal_comma: bool,
    /// The columns' names, and their units where these have a line of their own.
    pub(super) names: Vec<String>,
    pub(super) units: Vec<String>,
    /// Whether the file says the names.
    pub(super) named: bool,
    /// The line of the first row, from 1, and its offset in the text.
    pub(super) first_line: usize,
    pub(super) offset: usize,
}

impl Written {
    /// What the dialect is, for people.
    pub(super) fn form(&self) -> String {
        let delimiter = match self.delimiter {
            '\t' => "tabs".to_owned(),
            ' ' => "blanks".to_owned(),
            ',' => "commas".to_owned(),
            ';' => "semicolons".to_owned(),
            other => format!("`{other}`"),
        };
        let decimal = if self.decimal_comma { ", decimal comma" } else { "" };
        let header = if self.named { "" } else { ", no header" };
        format!("CSV, columns separated by {delimiter}{decimal}{header}")
    }
}

/// Cells that stand for no value.
const MISSING: [&str; 14] =
    ["", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?", "inf", "-inf", "+inf", "nil"];

/// Whether a cell stands for no value. Infinity is none, either.
pub(super) fn is_missing(cell: &str, extra: &[String]) -> bool {
    MISSING.iter().any(|missing| cell.eq_ignore_ascii_case(missing)) || extra.iter().any(|text| text == cell)
}

/// Whether a cell is a list, as tables of arms and of data frames have them.
pub(super) fn is_list(cell: &str) -> bool {
    cell.starts_with('[') && cell.ends_with(']')
}

/// The number in a cell.
pub(super) fn number(cell: &str, decimal_comma: bool) -> Option<f64> {
    let number = if decimal_comma && cell.contains(',') {
        if cell.contains('.') {
            return None;
        }
        cell.replacen(',', ".", 1).parse().ok()
    } else {
        cell.parse().ok()
    };
    number.filter(|number: &f64| number.is_finite()).or_else(|| match cell.to_ascii_lowercase().as_str() {
        "true" => Some(1.0),
        "false" => Some(0.0),
        _ => None,
    })
}

/// The text of a file, whatever its encoding.
pub(super) fn decode(bytes: Vec<u8>) -> String {
    let wide = |bytes: &[u8], order: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks_exact(2).map(|pair| order([pair[0], pair[1]])).collect();
        String::from_utf16_lossy(&units)
    };
    match bytes.as_slice() {
        [0xff, 0xfe, rest @ ..] => wide(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => wide(rest, u16::from_be_bytes),
        _ => {
            let text = String::from_utf8(bytes).unwrap_or_else(|error| {
                // Latin-1: what old loggers write a degree sign in.
                error.as_bytes().iter().map(|byte| char::from(*byte)).collect()
            });
            text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text)
        }
    }
}

/// The cells of a line.
pub(super) fn split(line: &str, delimiter: char) -> Vec<&str> {
    let line = line.trim_end_matches(['\r', '\n']);
    if delimiter == ' ' {
        return line.split_whitespace().collect();
    }
    let mut cells = Vec::new();
    let (mut start, mut quoted) = (0, false);
    for (at, c) in line.char_indices() {
        if c == '"' {
            quoted = !quoted;
        } else if c == delimiter && !quoted {
            cells.push(cell(&line[start..at]));
            start = at + c.len_utf8();
        }
    }
    cells.push(cell(&line[start..]));
    cells
}

fn cell(text: &str) -> &str {
    let text = text.trim();
    text.strip_prefix('"').and_then(|rest| rest.strip_suffix('"')).unwrap_or(text).trim()
}

/// How much of the beginning is looked at.
const LOOKED_AT: usize = 400;

/// Finds out how a text is written; `None` when it has no rows with a number.
pub(super) fn find(text: &str, known: &Dialect) -> Option<Written> {
    let lines: Vec<&str> = text.lines().take(LOOKED_AT).collect();
    let candidates: Vec<char> = known.delimiter.map_or_else(|| vec![',', ';', '\t', '|', ' '], |d| vec![d]);
    let (delimiter, decimal_comma, width) = candidates
        .into_iter()
        .flat_map(|delimiter| {
            let decimal: Vec<bool> = match known.decimal_comma {
                Some(comma) => vec![comma],
                None if delimiter == ',' => vec![false],
                None => vec![false, true],
            };
            decimal.into_iter().map(move |comma| (delimiter, comma))
        })
        .filter_map(|(delimiter, comma)| {
            let (score, width) = score(&lines, delimiter, comma, known)?;
            Some(((delimiter, comma, width), score))
        })
        // The first of equals: a point before a comma.
        .reduce(|best, next| if next.1 > best.1 + 1e-9 { next } else { best })?
        .0;

    let is_row = |line: &&str| {
        let cells = trimmed(split(line, delimiter), width);
        !is_comment(line)
            && cells.len() == width
            && cells.iter().any(|cell| number(cell, decimal_comma).is_some() || is_date(cell))
    };
    let first = match known.header {
        Some(header) => header,
        None => lines.iter().position(is_row)?,
    };
    // The header is the last line above that has as many cells; it may be marked as a comment.
    let names_of = |index: usize| {
        let line = lines.get(index)?.trim_start().trim_start_matches(['#', '%']).trim();
        let cells = trimmed(split(line, delimiter), width);
        (cells.len() == width && cells.iter().any(|cell| !cell.is_empty())).then_some(cells)
    };
    let above = match known.header {
        Some(0) => None,
        Some(header) => names_of(header - 1).map(|cells| (header - 1, cells)),
        None => (0..first).rev().find_map(|index| Some((index, names_of(index)?))),
    };
    let mut units = vec![String::new(); width];
    let mut names = above.as_ref().map(|(_, cells)| cells.clone());
    if let (Some((index, cells)), None) = (&above, known.header) {
        let unit = |cell: &str| cell.trim_matches(['[', ']', '(', ')']).trim().to_owned();
        let of_units = cells
            .iter()
            .all(|cell| matches!(unit(cell).as_str(), "" | "-" | "1") || units::is_known(&unit(cell)));
        if let (true, Some(upper)) = (of_units, index.checked_sub(1).and_then(names_of)) {
            units = cells.iter().map(|cell| units::plain(&unit(cell))).collect();
            names = Some(upper);
        }
    }
    let named = names.is_some();
    let names = names.map_or_else(
        || (1..=width).map(|number| format!("column_{number}")).collect(),
        // The column of a data frame's index has no name.
        |names| {
            let name = |(index, name): (usize, &str)| match name {
                "" => format!("column_{}", index + 1),
                name => name.to_owned(),
            };
            names.into_iter().enumerate().map(name).collect()
        },
    );
    let offset = text.split_inclusive('\n').take(first).map(str::len).sum();
    Some(Written { delimiter, decimal_comma, names, units, named, first_line: first + 1, offset })
}

/// Whether a line says nothing to a program.
pub(super) fn is_comment(line: &str) -> bool {
    let line = line.trim_start();
    line.is_empty() || line.starts_with(['#', '%'])
}

/// Without the empty cell that a delimiter at the end of the line leaves.
pub(super) fn trimmed(mut cells: Vec<&str>, width: usize) -> Vec<&str> {
    if cells.len() == width + 1 && cells.last().is_some_and(|cell| cell.is_empty()) {
        cells.pop();
    }
    cells
}

/// How well a delimiter and a decimal mark explain the lines, and how many columns there are then.
fn score(lines: &[&str], delimiter: char, decimal_comma: bool, known: &Dialect) -> Option<(f64, usize)> {
    // The end of what is looked at is far from any header.
    let rows: Vec<Vec<&str>> = lines
        .iter()
        .skip(lines.len() / 3)
        .filter(|line| !is_comment(line))
        .map(|line| split(line, delimiter))
        .collect();
    let mut counts: Vec<usize> = rows.iter().map(Vec::len).collect();
    counts.sort_unstable();
    let width = *counts.get(counts.len() / 2)?;
    let even = counts.iter().filter(|count| **count == width).count() as f64 / counts.len() as f64;
    let (mut good, mut all, mut numbers) = (0_usize, 0_usize, 0_usize);
    for cell in rows.iter().filter(|row| row.len() == width).flatten() {
        all += 1;
        let is_number = number(cell, decimal_comma).is_some();
        numbers += usize::from(is_number);
        good += usize::from(is_number || is_missing(cell, &known.missing) || is_date(cell) || is_list(cell));
    }
    // A delimiter at the end of every line is no column.
    let empty_end = rows.iter().all(|row| row.last().is_some_and(|cell| cell.is_empty()));
    let width = if empty_end && width > 1 { width - 1 } else { width };
    let several = if width > 1 { 1.0 } else { 0.3 };
    (numbers > 0).then(|| (even * several * good as f64 / all as f64, width))
}

/// The header's name and unit of each column.
pub(super) fn labels(written: &Written) -> Vec<(String, String)> {
    let label = |(name, unit): (&String, &String)| {
        let (name, own) = header::split(name);
        (name, if unit.is_empty() { own } else { unit.clone() })
    };
    written.names.iter().zip(&written.units).map(label).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(text: &str, delimiter: char, decimal_comma: bool, names: &[&str], first_line: usize) {
        let found = find(text, &Dialect::default()).unwrap();
        assert_eq!((found.delimiter, found.decimal_comma), (delimiter, decimal_comma), "{found:?}");
        assert_eq!(
            (found.names.as_slice(), found.first_line),
            (&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>()[..], first_line)
        );
        assert!(text[found.offset..].starts_with(text.lines().nth(first_line - 1).unwrap()));
    }

    #[test]
    fn dialects_are_found() {
        check("t,u\n0,1\n0.1,2\n", ',', false, &["t", "u"], 2);
        check("t;u\n0;1,5\n0,1;2\n", ';', true, &["t", "u"], 2);
        check("t;u\n0;1.5\n0.1;2\n", ';', false, &["t", "u"], 2);
        check("t\tu\n0\t1\n", '\t', false, &["t", "u"], 2);
        check("# t x y\n0 1 2\n0.1  2   3\n", ' ', false, &["t", "x", "y"], 2);
        check("t x\n0,0 1,5\n0,1 2,5\n", ' ', true, &["t", "x"], 2);
        check("t, u\n0, 1\n0.1, 2\n", ',', false, &["t", "u"], 2);
        check("0,1\n0.1,2\n", ',', false, &["column_1", "column_2"], 1);
        check("Logger,7\nrate,1000\n\nt;u;\n0;1;\n0,1;2;\n0,2;3;\n0,3;3;\n", ';', true, &["t", "u"], 5);
        check("time,mode,u\n0,RUN,1\n1,RUN,2\n", ',', false, &["time", "mode", "u"], 2);
        check(
            "2024-05-01 12:00:00,5;1,5\n2024-05-01 12:00:01,5;1,5\n",
            ';',
            true,
            &["column_1", "column_2"],
            1,
        );
    }

    #[test]
    fn a_line_of_units_is_one() {
        let found = find("time;pos\ns;rad\n0;1,5\n0,1;2\n", &Dialect::default()).unwrap();
        assert_eq!(
            (found.units, found.names),
            (vec!["s".into(), "rad".into()], vec!["time".into(), "pos".into()])
        );
        let found = find("s,m\n0,1.5\n0.1,2\n", &Dialect::default()).unwrap();
        assert_eq!((found.units, found.names), (vec![String::new(); 2], vec!["s".into(), "m".into()]));
    }

    #[test]
    fn encodings_are_found() {
        let text = "t,ϕ [°]\n0,1\n";
        assert_eq!(decode(text.as_bytes().to_vec()), text);
        assert_eq!(decode(["\u{feff}", text].concat().into_bytes()), text);
        for (mark, order) in
            [([0xff, 0xfe], u16::to_le_bytes as fn(u16) -> [u8; 2]), ([0xfe, 0xff], u16::to_be_bytes)]
        {
            let wide: Vec<u8> = mark.into_iter().chain(text.encode_utf16().flat_map(order)).collect();
            assert_eq!(decode(wide), text);
        }
        assert_eq!(decode(b"t,a [\xb0]\n".to_vec()), "t,a [°]\n");
    }

    #[test]
    fn text_without_numbers_is_no_table() {
        for text in ["", "\n\n", "hello\nworld\n", "a,b\n"] {
            assert_eq!(find(text, &Dialect::default()), None, "{text:?}");
        }
    }
}
