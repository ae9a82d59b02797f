//! What can be wrong with a `system.toml`.

use std::fmt;

/// A line of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Location {
    /// The file's name as it was given.
    pub file: Box<str>,
    /// Line, counted from 1; 0 when no line applies.
    pub line: usize,
}

impl Location {
    pub(crate) fn new(file: &str, line: usize) -> Self {
        Self { file: file.into(), line }
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.line {
            0 => write!(f, "{}", self.file),
            line => write!(f, "{}:{line}", self.file),
        }
    }
}

/// An expression and the position in it that a message speaks of.
///
/// Shown as the expression's line with a caret below it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Excerpt {
    /// The expression as the file states it.
    pub text: Box<str>,
    /// Position in characters from the start of `text`, counted from 0.
    pub position: usize,
}

impl fmt::Display for Excerpt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // An expression may span lines: show the one that holds the position.
        let mut column = self.position;
        let mut shown = "";
        for line in self.text.split('\n') {
            shown = line;
            let length = line.chars().count();
            if column <= length {
                break;
            }
            column -= length + 1;
        }
        // A long line is cut to the neighbourhood of the caret.
        let start = column.saturating_sub(60);
        let cut: String =
            shown.chars().skip(start).take(100).map(|c| if c == '\t' { ' ' } else { c }).collect();
        write!(f, "\n    {cut}\n    {}^", " ".repeat(column - start))
    }
}

/// A suggestion, shown as `; did you mean ...?` or nothing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Suggestion(pub Option<Box<str>>);

impl Suggestion {
    /// The nearest of `candidates` to `name`, if one is near.
    pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Self {
        Self(nearest(name, candidates).map(Into::into))
    }
}

impl fmt::Display for Suggestion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(name) => write!(f, "; did you mean `{name}`?"),
            None => Ok(()),
        }
    }
}

/// The candidate with the smallest edit distance to `name`, if at most a third of its letters differ
/// (at least one letter may).
///
/// ```
/// use parallax_model::system::nearest;
/// assert_eq!(nearest("positon", ["velocity", "position"]), Some("position"));
/// assert_eq!(nearest("current", ["velocity", "position"]), None);
/// ```
pub fn nearest<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let letters: Vec<char> = name.chars().take(64).collect();
    let allowed = (letters.len() / 3).max(1);
    candidates
        .into_iter()
        .map(|candidate| (distance(&letters, candidate), candidate))
        .filter(|&(distance, candidate)| {
            distance <= allowed && distance < candidate.chars().count().min(letters.len())
        })
        .min_by_key(|&(distance, _)| distance)
        .map(|(_, candidate)| candidate)
}

/// Levenshtein distance, case ignored.
fn distance(a: &[char], b: &str) -> usize {
    let mut row: Vec<usize> = (0..=a.len()).collect();
    for (i, letter) in b.chars().take(64).enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for j in 0..a.len() {
            let same = a[j].to_lowercase().eq(letter.to_lowercase());
            let replaced = diagonal + usize::from(!same);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[a.len()]
}

/// Why a `system.toml` cannot be used. Every message starts with the file and the line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SystemError {
    /// Nothing but blanks and comments.
    #[error("{at}: the file is empty; a system needs at least `format = 1`, `name` and `[outputs]`")]
    Empty {
        /// The file.
        at: Location,
    },
    /// Not TOML.
    #[error("{at}: not valid TOML: {message}")]
    Toml {
        /// Where the reader stopped.
        at: Location,
        /// What the TOML reader says.
        message: Box<str>,
    },
    /// No `format`.
    #[error("{at}: `format` is missing; write `format = 1` at the top")]
    MissingFormat {
        /// The file.
        at: Location,
    },
    /// A version that this build cannot read.
    #[error("{at}: format {found} is not supported; this version reads format 1")]
    UnsupportedFormat {
        /// The `format` line.
        at: Location,
        /// The version the file states.
        found: i64,
    },
    /// A key that means nothing here.
    #[error("{at}: unknown field `{field}` in {within}{suggestion} (known: {known})")]
    UnknownField {
        /// The key.
        at: Location,
        /// The key's name.
        field: Box<str>,
        /// The table that holds it.
        within: Box<str>,
        /// The nearest known field.
        suggestion: Suggestion,
        /// All known fields.
        known: Box<str>,
    },
    /// A key that must be there.
    #[error("{at}: {within} has no `{field}`; {remedy}")]
    MissingField {
        /// The table that lacks it.
        at: Location,
        /// The missing key.
        field: Box<str>,
        /// The table's name.
        within: Box<str>,
        /// What to write.
        remedy: Box<str>,
    },
    /// A value of the wrong kind.
    #[error("{at}: {field} must be {expected}, not {found}")]
    WrongType {
        /// The value.
        at: Location,
        /// Which value.
        field: Box<str>,
        /// What is wanted.
        expected: Box<str>,
        /// What is there.
        found: Box<str>,
    },
    /// A number that cannot be used: not finite, negative where that has no meaning, bounds reversed.
    #[error("{at}: {field}: {problem}")]
    BadValue {
        /// The value.
        at: Location,
        /// Which value.
        field: Box<str>,
        /// What is wrong and what to write.
        problem: Box<str>,
    },
    /// A name that expressions could not use.
    #[error("{at}: `{name}` cannot be a name: {problem}")]
    BadName {
        /// The key.
        at: Location,
        /// The name.
        name: Box<str>,
        /// Why not.
        problem: Box<str>,
    },
    /// One name for two things that expressions refer to.
    #[error("{at}: `{name}` is already {first_kind} (line {first_line}); give one of them another name")]
    DuplicateName {
        /// The second.
        at: Location,
        /// The name.
        name: Box<str>,
        /// What the first one is.
        first_kind: &'static str,
        /// Line of the first.
        first_line: usize,
    },
    /// An expression that cannot be read.
    #[error("{at}: {of}: {problem}{excerpt}")]
    Syntax {
        /// The expression's string.
        at: Location,
        /// Whose expression it is.
        of: Box<str>,
        /// What is wrong.
        problem: Box<str>,
        /// The expression and the position.
        excerpt: Excerpt,
    },
    /// A function that does not exist.
    #[error("{at}: {of}: unknown function `{name}`{suggestion}{excerpt}")]
    UnknownFunction {
        /// The expression's string.
        at: Location,
        /// Whose expression it is.
        of: Box<str>,
        /// The name.
        name: Box<str>,
        /// The nearest function.
        suggestion: Suggestion,
        /// The expression and the position.
        excerpt: Excerpt,
    },
    /// A function with too many or too few arguments.
    #[error("{at}: {of}: `{name}` takes {expected} argument(s), not {found}{excerpt}")]
    WrongArity {
        /// The expression's string.
        at: Location,
        /// Whose expression it is.
        of: Box<str>,
        /// The function.
        name: &'static str,
        /// How many it takes.
        expected: usize,
        /// How many there are.
        found: usize,
        /// The expression and the position.
        excerpt: Excerpt,
    },
    /// A name that nothing defines.
    #[error("{at}: {of}: unknown name `{name}`{suggestion}{}{excerpt}",
        if suggestion.0.is_none() { *hint } else { "" })]
    UnknownName {
        /// The expression's string.
        at: Location,
        /// Whose expression it is.
        of: Box<str>,
        /// The name.
        name: Box<str>,
        /// The nearest name.
        suggestion: Suggestion,
        /// Where such a name could be defined.
        hint: &'static str,
        /// The expression and the position.
        excerpt: Excerpt,
    },
    /// Named expressions that need each other.
    #[error("{at}: the expressions of [let] need each other in a circle: {}; make one of them a state or write it out",
        cycle.join(" -> "))]
    Cycle {
        /// The first of them.
        at: Location,
        /// Their names; the first is repeated at the end.
        cycle: Vec<String>,
    },
    /// A joint, effect or payload that names something that is not there.
    #[error("{at}: {within} names {kind} `{name}`, which does not exist{suggestion}")]
    Absent {
        /// The string.
        at: Location,
        /// What names it.
        within: Box<str>,
        /// What it should be.
        kind: &'static str,
        /// The name.
        name: Box<str>,
        /// The nearest that exists.
        suggestion: Suggestion,
    },
    /// A constant of a recording that cannot be used.
    #[error("{file}: the recording's constant `{name}`: {problem}")]
    BadConstant {
        /// The system's file.
        file: Box<str>,
        /// The constant.
        name: Box<str>,
        /// What is wrong with it.
        problem: Box<str>,
    },
    /// A signal that the recording does not have.
    #[error(
        "{at}: {within} names the signal `{signal}`, which the recording does not have{suggestion} (it has: {available})"
    )]
    MissingSignal {
        /// The entry that names it.
        at: Location,
        /// What names it.
        within: Box<str>,
        /// The signal.
        signal: Box<str>,
        /// The nearest recorded one.
        suggestion: Suggestion,
        /// All recorded ones.
        available: Box<str>,
    },
    /// An output and its signal with different units.
    #[error(
        "{at}: output `{output}` is in `{unit}` but its signal `{signal}` is recorded in `{recorded}`; convert one of them"
    )]
    UnitMismatch {
        /// The output.
        at: Location,
        /// The output's name.
        output: Box<str>,
        /// The output's unit.
        unit: Box<str>,
        /// The signal.
        signal: Box<str>,
        /// The signal's unit.
        recorded: Box<str>,
    },
}
