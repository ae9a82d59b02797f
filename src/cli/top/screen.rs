//! Draws a running graph on the terminal until somebody leaves or the run is over.

use std::io::{self, Write};
use std::time::{Duration, Instant};

use crossterm::cursor::{Hide, MoveTo, Show};
use crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use crossterm::style::{Attribute, Color, ResetColor, SetAttribute, SetForegroundColor};
use crossterm::terminal::{
    BeginSynchronizedUpdate, Clear, ClearType, EndSynchronizedUpdate, EnterAlternateScreen,
    LeaveAlternateScreen, disable_raw_mode, enable_raw_mode, size,
};
use crossterm::{execute, queue};
use parallax_runtime::launch::LiveRun;
use parallax_runtime::launch::signals::Signals;
use parallax_runtime::time::Nanos;

use super::page::{self, Line, Tone};
use super::{Past, Stopped, is_over};

/// How long a signal or the end of the run may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
const KEYS: &str = "q quit   space hold   up, down scroll";

/// The terminal while it is ours: it is given back as it was, however this ends.
struct Terminal;

impl Terminal {
    fn take() -> io::Result<Self> {
        enable_raw_mode()?;
        let taken = Self;
        execute!(io::stdout(), EnterAlternateScreen, Hide)?;
        Ok(taken)
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // A terminal that is gone needs nothing back.
        let _ =
            execute!(io::stdout(), ResetColor, SetAttribute(Attribute::Reset), Show, LeaveAlternateScreen);
        let _ = disable_raw_mode();
    }
}

/// Draws until somebody leaves.
pub(super) fn show(
    run: &LiveRun,
    past: &mut Past,
    interval: Nanos,
    signals: &Signals,
) -> io::Result<Stopped> {
    let interval = Duration::from_nanos(interval.unsigned_abs());
    let _terminal = Terminal::take()?;
    let mut shown = page::lines(&past.look(run));
    let (mut held, mut first) = (false, 0);
    draw(&shown, first, held)?;
    // The first look has no past; the next one comes soon.
    let mut next = Instant::now() + interval.min(Duration::from_millis(250));
    loop {
        let wait = next.saturating_duration_since(Instant::now()).min(PATIENCE);
        if event::poll(wait)? {
            match event::read()? {
                Event::Key(key) if key.kind != KeyEventKind::Release => match key.code {
                    KeyCode::Char('q') | KeyCode::Esc => return Ok(Stopped::Left),
                    KeyCode::Char('c' | 'd') if key.modifiers.contains(KeyModifiers::CONTROL) => {
                        return Ok(Stopped::Left);
                    }
                    KeyCode::Char(' ') => held = !held,
                    KeyCode::Down | KeyCode::Char('j') => {
                        first = (first + 1).min(shown.len().saturating_sub(1))
                    }
                    KeyCode::Up | KeyCode::Char('k') => first = first.saturating_sub(1),
                    _ => continue,
                },
                Event::Resize(..) => {}
                _ => continue,
            }
            draw(&shown, first, held)?;
            continue;
        }
        if signals.raised() {
            return Ok(Stopped::Signal);
        }
        let over = is_over(run.phase());
        if Instant::now() >= next || over {
            let snapshot = past.look(run);
            if is_over(snapshot.phase) {
                return Ok(Stopped::Over(Box::new(snapshot)));
            }
            next = Instant::now() + interval;
            if !held {
                shown = page::lines(&snapshot);
                draw(&shown, first, held)?;
            }
        }
    }
}

/// Draws the lines from `first` on, as many as there is room for, and the keys below.
fn draw(lines: &[Line], first: usize, held: bool) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let (width, height) = size()?;
    queue!(out, BeginSynchronizedUpdate)?;
    let room = usize::from(height.saturating_sub(1));
    for row in 0..room {
        queue!(out, MoveTo(0, row as u16))?;
        if let Some(line) = lines.get(first + row) {
            write(&mut out, line, width)?;
        }
        queue!(out, Clear(ClearType::UntilNewLine))?;
    }
    queue!(out, MoveTo(0, room as u16))?;
    let keys = if held { format!("held   {KEYS}") } else { KEYS.to_owned() };
    write(&mut out, &Line(vec![(keys, Tone::Head)]), width)?;
    queue!(out, Clear(ClearType::UntilNewLine), EndSynchronizedUpdate)?;
    out.flush()
}

/// Writes what of a line fits into the width.
fn write(out: &mut impl Write, line: &Line, width: u16) -> io::Result<()> {
    let mut left = usize::from(width);
    for (text, tone) in &line.0 {
        let piece: String = text.chars().take(left).collect();
        left -= piece.chars().count();
        match tone {
            Tone::Plain => {}
            Tone::Head => queue!(out, SetAttribute(Attribute::Bold))?,
            Tone::Alarm => queue!(out, SetForegroundColor(Color::Red))?,
        }
        out.write_all(piece.as_bytes())?;
        if *tone != Tone::Plain {
            queue!(out, SetAttribute(Attribute::Reset), ResetColor)?;
        }
    }
    Ok(())
}
