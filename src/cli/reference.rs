//! `docs/cli.md`: every command, from the same definitions as `--help`.

use std::fmt::Write;

use clap::{Arg, ArgAction, Command};

/// The hidden command that prints the page.
pub(super) const COMMAND: &str = "reference";

const HEAD: &str = "\
# Commands

<!-- Made by `make reference` from what `--help` prints. Change the text there: in src/cli. -->

";

/// The page: every command that is not hidden, in the order of `--help`.
pub(super) fn page(mut program: Command) -> String {
    // Usage lines and the arguments that all commands share.
    program.build();
    let mut page = String::from(HEAD);
    let exit_codes = program.get_after_help().map(ToString::to_string).unwrap_or_default();
    let mut about = sentences(&program);
    about += "\n\n| command | |\n|---|---|\n";
    for command in shown(&program) {
        let name = command.get_name();
        let short = command.get_about().map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(about, "| [`{name}`](#parallax-{name}) | {}. |", cell(&short).trim_end_matches('.'));
    }
    page += &about;
    let _ = write!(page, "\nEvery command takes `--help`, `--version` and");
    let everywhere = program.get_arguments().filter(|argument| argument.is_global_set() && !fixed(argument));
    for argument in everywhere {
        let _ = write!(page, " {} ({})", names(argument), help(argument).trim_end_matches('.'));
    }
    let _ = write!(page, ".\n\n```text\n{exit_codes}\n```\n");
    for command in shown(&program) {
        section(&mut page, "parallax", command, &exit_codes);
    }
    page
}

fn shown(command: &Command) -> impl Iterator<Item = &Command> {
    command.get_subcommands().filter(|command| !command.is_hide_set() && command.get_name() != "help")
}

/// `--help` and `--version`.
fn fixed(argument: &Arg) -> bool {
    matches!(
        argument.get_action(),
        ArgAction::Help | ArgAction::HelpShort | ArgAction::HelpLong | ArgAction::Version
    )
}

fn section(page: &mut String, within: &str, command: &Command, exit_codes: &str) {
    let name = format!("{within} {}", command.get_name());
    let level = if within.contains(' ') { "###" } else { "##" };
    let _ = write!(page, "\n{level} `{name}`\n\n{}\n", sentences(command));
    if shown(command).next().is_some() {
        for inner in shown(command) {
            section(page, &name, inner, exit_codes);
        }
        return;
    }
    let usage = command.clone().render_usage().to_string();
    let usage = usage.trim_start_matches("Usage: ").trim();
    let _ = write!(page, "\n```text\n{usage}\n```\n");
    let arguments: Vec<&Arg> = command
        .get_arguments()
        .filter(|argument| !argument.is_hide_set() && !argument.is_global_set() && !fixed(argument))
        .collect();
    if !arguments.is_empty() {
        *page += "\n| argument | meaning |\n|---|---|\n";
        for argument in arguments {
            let _ = writeln!(page, "| {} | {} |", names(argument), cell(&help(argument)));
        }
    }
    let after = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    if !after.is_empty() && after != exit_codes {
        let _ = write!(page, "\n```text\n{after}\n```\n");
    }
}

/// What a command does.
fn sentences(command: &Command) -> String {
    let about = command.get_long_about().or_else(|| command.get_about());
    let text = about.map(ToString::to_string).unwrap_or_default().trim().to_owned();
    if text.ends_with('.') { text } else { text + "." }
}

/// As it is written on the command line.
fn names(argument: &Arg) -> String {
    let values: Vec<String> = argument
        .get_value_names()
        .unwrap_or_default()
        .iter()
        .map(|name| if argument.is_positional() { name.to_string() } else { format!("<{name}>") })
        .collect();
    let values = if argument.get_action().takes_values() { values.join(" ") } else { String::new() };
    let many = argument.get_num_args().is_some_and(|count| count.max_values() > 1);
    let dots = if many || matches!(argument.get_action(), ArgAction::Append) { "..." } else { "" };
    let short = argument.get_short().map(|short| format!("-{short}"));
    let long = argument.get_long().map(|long| format!("--{long}"));
    let flags: Vec<String> = short.into_iter().chain(long).collect();
    let text = format!("{} {values}{dots}", flags.join(", "));
    format!("`{}`", cell(text.trim()))
}

/// Its meaning, its default, and the values that it may have.
fn help(argument: &Arg) -> String {
    let help = argument.get_long_help().or_else(|| argument.get_help());
    let mut text = help.map(ToString::to_string).unwrap_or_default();
    // clap takes away the last full stop.
    if !text.is_empty() && !text.ends_with('.') {
        text.push('.');
    }
    if argument.get_action().takes_values() {
        let of = |value: &clap::builder::PossibleValue| {
            let name = format!("`{}`", value.get_name());
            value.get_help().map_or(name.clone(), |help| format!("{name} ({help})"))
        };
        let values: Vec<String> =
            argument.get_possible_values().iter().filter(|value| !value.is_hide_set()).map(of).collect();
        if !values.is_empty() {
            let _ = write!(text, " One of: {}.", values.join(", "));
        }
        let defaults: Vec<String> =
            argument.get_default_values().iter().map(|value| value.to_string_lossy().into_owned()).collect();
        if !defaults.is_empty() {
            let _ = write!(text, " Default: `{}`.", defaults.join(" "));
        }
    }
    text
}

/// Text that can stand in a cell of a table.
fn cell(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|")
}
