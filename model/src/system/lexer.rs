//! Cuts the text of an expression into tokens.

/// A word of an expression.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Token {
    Number(f64),
    Name(Box<str>),
    Symbol(&'static str),
}

/// A token and where it starts, in characters.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Placed {
    pub(super) token: Token,
    pub(super) position: usize,
}

/// What is wrong and where, in characters from the start.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Misspelt {
    pub(super) problem: Box<str>,
    pub(super) position: usize,
}

/// Longer symbols first, so that `<=` is not read as `<` and `=`.
const SYMBOLS: [&str; 14] = ["<=", ">=", "==", "+", "-", "*", "/", "^", "(", ")", ",", "<", ">", ";"];

/// Notations of other languages, and what to write instead.
const FOREIGN: [(&str, &str); 7] = [
    ("**", "write a power as `^`"),
    ("!=", "there is no `!=`; write `1 - (a == b)`"),
    ("&&", "there is no `&&`; a comparison is 1 or 0, so multiply the two"),
    ("||", "there is no `||`; a comparison is 1 or 0, so write `max(a, b)`"),
    ("=", "write equality as `==`"),
    ("!", "there is no `!`; write `1 - (...)`"),
    ("%", "there is no `%`; write `a - b*floor(a/b)`"),
];

pub(super) fn is_name_start(c: char) -> bool {
    c.is_alphabetic() || c == '_'
}

pub(super) fn is_name_part(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

pub(super) fn tokens(text: &str) -> Result<Vec<Placed>, Misspelt> {
    let mut out = Vec::new();
    let mut rest = text;
    let mut position = 0;
    while let Some(first) = rest.chars().next() {
        if first.is_whitespace() {
            rest = &rest[first.len_utf8()..];
            position += 1;
            continue;
        }
        let misspelt = |problem: &str| Misspelt { problem: problem.into(), position };
        let (token, bytes) = if first.is_ascii_digit() || first == '.' {
            number(rest).map_err(misspelt)?
        } else if is_name_start(first) {
            let bytes = rest.find(|c| !is_name_part(c)).unwrap_or(rest.len());
            (Token::Name(rest[..bytes].into()), bytes)
        } else if let Some(symbol) = symbol(rest) {
            (Token::Symbol(symbol), symbol.len())
        } else {
            let foreign = FOREIGN.iter().find(|(notation, _)| rest.starts_with(notation));
            return Err(match foreign {
                Some((_, remedy)) => misspelt(remedy),
                None => misspelt(&format!("the character `{}` has no meaning here", first.escape_debug())),
            });
        };
        out.push(Placed { token, position });
        position += rest[..bytes].chars().count();
        rest = &rest[bytes..];
    }
    Ok(out)
}

fn symbol(rest: &str) -> Option<&'static str> {
    // `**` would otherwise be two multiplications, with a message about the second.
    if rest.starts_with("**") {
        return None;
    }
    SYMBOLS.into_iter().find(|symbol| rest.starts_with(symbol))
}

/// A decimal number with optional fraction and exponent at the start of `rest`, and its length in bytes.
fn number(rest: &str) -> Result<(Token, usize), &'static str> {
    let digits = |from: usize| rest[from..].bytes().take_while(u8::is_ascii_digit).count();
    let whole = digits(0);
    let mut end = whole;
    let mut fraction = 0;
    if rest[end..].starts_with('.') {
        fraction = digits(end + 1);
        end += 1 + fraction;
    }
    if whole + fraction == 0 {
        return Err("a `.` belongs to a number; names have no parts, so write `q`, not `joint.q`");
    }
    if rest[end..].starts_with(['e', 'E']) {
        let sign = usize::from(rest[end + 1..].starts_with(['+', '-']));
        let exponent = digits(end + 1 + sign);
        if exponent > 0 {
            end += 1 + sign + exponent;
        }
    }
    if rest[end..].starts_with(|c: char| is_name_part(c) || c == '.') {
        return Err("the number is not followed by an operator; write `2*x`, not `2x`");
    }
    match rest[..end].parse::<f64>() {
        Ok(value) if value.is_finite() => Ok((Token::Number(value), end)),
        _ => Err("the number is too large"),
    }
}
