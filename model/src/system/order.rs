//! Orders named expressions so that each needs only earlier ones.

use std::collections::BTreeMap;

use super::error::{Location, SystemError};
use super::parts::Let;

/// Keeps the order of the file where it can.
pub(super) fn by_need(lets: Vec<Let>, file: &str) -> Result<Vec<Let>, SystemError> {
    let index: BTreeMap<&str, usize> =
        lets.iter().enumerate().map(|(i, entry)| (entry.name.as_str(), i)).collect();
    let needs: Vec<Vec<usize>> = lets
        .iter()
        .map(|entry| entry.expression.names().filter_map(|name| index.get(name).copied()).collect())
        .collect();

    let mut done = vec![false; lets.len()];
    let mut order = Vec::with_capacity(lets.len());
    loop {
        let before = order.len();
        for i in 0..lets.len() {
            if !done[i] && needs[i].iter().all(|need| done[*need]) {
                done[i] = true;
                order.push(i);
            }
        }
        if order.len() == before {
            break;
        }
    }
    if order.len() < lets.len() {
        return Err(cycle(&lets, &needs, &done, file));
    }
    let mut lets: Vec<Option<Let>> = lets.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|i| lets[i].take()).collect())
}

/// Whatever is not done needs something that is not done: following that must come back to itself.
fn cycle(lets: &[Let], needs: &[Vec<usize>], done: &[bool], file: &str) -> SystemError {
    let mut path: Vec<usize> = done.iter().position(|done| !done).into_iter().collect();
    let start = loop {
        let Some(next) = path.last().and_then(|last| needs[*last].iter().copied().find(|need| !done[*need]))
        else {
            break 0;
        };
        if let Some(start) = path.iter().position(|seen| *seen == next) {
            break start;
        }
        path.push(next);
    };
    let path = &path[start..];
    let cycle = path.iter().chain(path.first()).map(|i| lets[*i].name.clone()).collect();
    SystemError::Cycle { at: Location::new(file, path.first().map_or(0, |i| lets[*i].line)), cycle }
}
