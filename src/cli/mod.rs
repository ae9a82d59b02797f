//! The commands. They wire the crates together; what they do is there.

pub(crate) mod args;
mod delays;
mod demo;
mod diagnose;
mod doctor;
mod experiment;
pub(crate) mod failure;
mod graph;
mod identify;
mod import;
mod info;
mod join;
mod kinds;
mod latency;
mod live;
mod lockstep;
mod new;
mod output;
mod printer;
mod python;
mod reference;
mod replay;
mod run;
mod sim;
mod supergraph;
mod task;
mod top;
mod tune;
mod withheld;

use std::process::ExitCode;

use clap::{ArgAction, CommandFactory, Parser, Subcommand};
use parallax_runtime::launch::{NODE_COMMAND, node_main};
use parallax_runtime::registry::Registry;
use tracing_subscriber::EnvFilter;

const EXIT_CODES: &str = "\
Exit codes:
  0    done
  1    done, and the answer is no: the replay differs from the recording, no experiment separates the effects, an aim
       of `latency` is missed, `doctor` found something to change
  2    the command or its input cannot be used
  3    the run failed, for instance because a node died
  130  interrupted; a diagnosis reports what was weighed until then, an identification the best so far, a run
       keeps its recording";

/// Runs a robot as a graph of nodes, replays it exactly under a simulated clock, and says where simulation and reality
/// part, why, and how much of the gap a cause explains.
#[derive(Parser)]
#[command(name = "parallax", version, after_help = EXIT_CODES, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Say more on standard error; twice for everything.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    verbose: u8,
}

#[derive(Subcommand)]
enum Command {
    /// Run a machine with a hidden flaw, record, replay and diagnose it.
    #[command(after_help = EXIT_CODES)]
    Demo(demo::Arguments),
    /// Run a graph in real time, each node a process.
    #[command(after_help = EXIT_CODES)]
    Run(run::Arguments),
    /// Watch a running graph: rates, lateness, delays, losses, as they are now.
    #[command(after_help = EXIT_CODES)]
    Top(top::Arguments),
    /// Show the messages of a running graph in Foxglove, live.
    #[command(after_help = EXIT_CODES)]
    Live(live::Arguments),
    /// Set parameters of a node of a running graph.
    #[command(after_help = tune::SET_HELP)]
    Set(tune::Set),
    /// Read what can be set of a node of a running graph, and its state.
    #[command(after_help = EXIT_CODES)]
    Get(tune::Get),
    /// Put the state of a node of a running graph back to what it was before its first step.
    #[command(after_help = EXIT_CODES)]
    Reset(tune::Reset),
    /// Run a graph under a simulated clock.
    #[command(after_help = EXIT_CODES)]
    Sim(sim::Arguments),
    /// Run the nodes of a recording again, on exactly what they consumed, and compare.
    #[command(after_help = EXIT_CODES)]
    Replay(replay::Arguments),
    /// Bring in a log of another program: CSV, Parquet, a ROS 2 bag.
    #[command(after_help = EXIT_CODES)]
    Import(import::Arguments),
    /// Write files to begin with: a system.toml of what your simulator believes, a graph.toml, a node of your own.
    #[command(after_help = EXIT_CODES)]
    New(new::Arguments),
    /// Say what is in a recording, a folder of logs, a graph or a system.
    #[command(after_help = EXIT_CODES)]
    Info(info::Arguments),
    /// Make one recording of the parts of a run: of --rotate, of a recorder that died, or of several machines.
    #[command(after_help = EXIT_CODES)]
    Join(join::Arguments),
    /// Say how long steps and messages took in a recording, and fit distributions to that.
    #[command(after_help = EXIT_CODES)]
    Delays(delays::Arguments),
    /// Show a graph, its schedule and its supergraph, in words and in pictures.
    #[command(after_help = EXIT_CODES)]
    Graph(graph::Arguments),
    /// List the kinds of node that a graph may name: what they take and what they send.
    #[command(after_help = EXIT_CODES)]
    Kinds(kinds::Arguments),
    /// Look at this machine as a place for nodes that must be on time, and say what to change.
    #[command(after_help = EXIT_CODES)]
    Doctor(doctor::Arguments),
    /// Measure how long messages and steps take on this machine, beside the raw floor.
    #[command(after_help = EXIT_CODES)]
    Latency(latency::Arguments),
    /// Say where a recording and its simulator part, why, and how far.
    #[command(after_help = EXIT_CODES)]
    Diagnose(diagnose::Arguments),
    /// Find parameters, first states and hidden delays from recordings.
    #[command(after_help = EXIT_CODES)]
    Identify(identify::Arguments),
    /// Design the commands that would tell apart what a diagnosis could not.
    #[command(after_help = EXIT_CODES)]
    Experiment(experiment::Arguments),
    /// Score the diagnosis on cases whose cause it cannot see.
    #[command(after_help = EXIT_CODES)]
    Withheld(withheld::Arguments),
    /// Do a whole task, from a recording of an unknown machine to policies that run on it: `parallax task pendulum`,
    /// `parallax task quadrotor`.
    #[command(after_help = EXIT_CODES)]
    Task(task::Arguments),
    /// Says what the machine of a task was.
    #[command(name = task::MACHINE_COMMAND, hide = true)]
    TaskMachine(task::MachineArguments),
    /// Makes the cases of `parallax withheld` and seals their answers.
    #[command(name = withheld::TRUTH_COMMAND, hide = true)]
    WithheldTruth(withheld::truth::Arguments),
    /// Plays a proposed experiment on a case's machine.
    #[command(name = withheld::separate::PLAY_COMMAND, hide = true)]
    WithheldPlay(withheld::separate::Arguments),
    /// One node of a measured graph.
    #[command(name = parallax_runtime::latency::NODE_COMMAND, hide = true)]
    LatencyNode {
        /// What the launcher says.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// The other process of a floor.
    #[command(name = parallax_runtime::latency::PEER_COMMAND, hide = true)]
    LatencyPeer {
        /// What is measured.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Prints docs/cli.md.
    #[command(name = reference::COMMAND, hide = true)]
    Reference,
    /// One node of a run; the launcher starts it.
    #[command(name = NODE_COMMAND, hide = true)]
    Node {
        /// What the launcher says.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
}

/// Reads the command line and does what it says; `own` adds kinds of node.
pub(crate) fn main(own: fn(Registry) -> Registry) -> ExitCode {
    python::add(own);
    let cli = Cli::parse();
    let level = ["warn", "info", "debug"][usize::from(cli.verbose.min(2))];
    // What zenoh says of every attempt to connect is for whoever looks for a fault in the network.
    let filter = if cli.verbose < 2 { format!("{level},zenoh=off") } else { level.into() };
    let filter = EnvFilter::try_from_env("PARALLAX_LOG").unwrap_or_else(|_| EnvFilter::new(filter));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();

    let result = match cli.command {
        Command::Node { arguments } => {
            return node_main(arguments.into_iter(), &crate::cli::python::registry());
        }
        Command::LatencyNode { arguments } => {
            return parallax_runtime::latency::node_main(arguments.into_iter());
        }
        Command::LatencyPeer { arguments } => {
            return parallax_runtime::latency::peer_main(arguments.into_iter());
        }
        Command::Reference => {
            output::line(reference::page(Cli::command()).trim_end());
            return ExitCode::SUCCESS;
        }
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Latency(arguments) => latency::run(&arguments),
        Command::Demo(arguments) => demo::run(&arguments),
        Command::Run(arguments) => run::run(&arguments),
        Command::Diagnose(arguments) => diagnose::run(&arguments),
        Command::Experiment(arguments) => experiment::run(&arguments),
        Command::Identify(arguments) => identify::run(&arguments),
        Command::Withheld(arguments) => withheld::run(&arguments),
        Command::Task(arguments) => task::run(&arguments),
        Command::TaskMachine(arguments) => task::machine(&arguments),
        Command::WithheldTruth(arguments) => withheld::truth::run(&arguments),
        Command::WithheldPlay(arguments) => withheld::separate::run(&arguments),
        Command::Set(arguments) => tune::set(&arguments),
        Command::Get(arguments) => tune::get(&arguments),
        Command::Reset(arguments) => tune::reset(&arguments),
        Command::Top(arguments) => top::run(&arguments),
        Command::Live(arguments) => live::run(&arguments),
        Command::Sim(arguments) => sim::run(&arguments),
        Command::Replay(arguments) => replay::run(&arguments),
        Command::Import(arguments) => import::run(&arguments),
        Command::New(arguments) => new::run(&arguments),
        Command::Info(arguments) => info::run(&arguments),
        Command::Join(arguments) => join::run(&arguments),
        Command::Delays(arguments) => delays::run(&arguments),
        Command::Graph(arguments) => graph::run(&arguments),
        Command::Kinds(arguments) => kinds::run(&arguments),
    };
    match result {
        Ok(outcome) => outcome.into(),
        Err(failure) => failure.report(),
    }
}
