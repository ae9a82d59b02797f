//! `parallax live`: the messages of a running graph, for Foxglove.

use clap::Args;
use parallax_runtime::time::Nanos;

use super::args::duration;
#[cfg(not(feature = "foxglove"))]
use super::failure::{Failure, Outcome};

/// It reads the file that the recorder writes: the nodes do not notice. Every message and every step is sent on as it is
/// recorded, about a tenth of a second later, with its schema, to whoever connects: in Foxglove, "Open connection",
/// "Foxglove WebSocket", and the address that is printed. It ends with the run.
#[derive(Args)]
pub(crate) struct Arguments {
    /// The run: its id, the process of its launcher, or the name of its graph. Without it, the only one.
    run: Option<String>,
    /// The address to listen at. Others than this machine's own let everybody who reaches it look on.
    #[arg(long, default_value = "127.0.0.1")]
    host: String,
    /// The port to listen at; 0 takes one that is free.
    #[arg(long, default_value_t = 8765)]
    port: u16,
    /// How often to look for what is new.
    #[arg(long, value_name = "SECONDS", value_parser = duration, default_value = "0.05")]
    interval: Nanos,
    /// Print the address and the topics as JSON.
    #[arg(long)]
    json: bool,
}

#[cfg(not(feature = "foxglove"))]
pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let Arguments { run: _, host: _, port: _, interval: _, json: _ } = arguments;
    Err(Failure::input(anyhow::anyhow!(
        "this program was built without the feature `foxglove`; build it with it: cargo build --release --features foxglove"
    )))
}

#[cfg(feature = "foxglove")]
pub(crate) use server::run;

#[cfg(feature = "foxglove")]
mod server {
    use std::collections::BTreeMap;
    use std::path::PathBuf;
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    use anyhow::{Context as _, anyhow};
    use foxglove::{ChannelBuilder, Context, PartialMetadata, RawChannel, Schema, WebSocketServer};
    use parallax_runtime::launch::signals::Signals;
    use parallax_runtime::launch::{LiveRun, Phase};
    use parallax_runtime::recording::follow::{Channel, Follow, Followed};
    use serde::Serialize;

    use super::super::failure::{Failure, Outcome, Sort};
    use super::super::{output, top};
    use super::Arguments;

    /// How long a recorder may take to begin its file.
    const PATIENCE: Duration = Duration::from_secs(10);
    /// How long the end of a recording is waited for.
    const LAST: Duration = Duration::from_secs(3);
    /// How often the recorder is told that somebody looks on.
    const KEEP: Duration = Duration::from_millis(500);
    /// Messages that are kept for somebody who is slow; older ones are dropped.
    const BACKLOG: usize = 4096;

    /// What is printed for a script.
    #[derive(Serialize)]
    struct Address<'a> {
        url: &'a str,
        run: &'a str,
        graph: &'a str,
        topics: Vec<&'a str>,
    }

    pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
        let run = LiveRun::find(arguments.run.as_deref()).map_err(top::sort)?;
        let signals = Signals::watch().runtime()?;
        let watch = run.watch().context("the run cannot be looked at; is it over?");
        let watch = watch.map_err(Failure::runtime)?;
        let Some(mut pages) = Pages::begin(&run, &signals)? else { return Ok(Outcome::Interrupted) };
        let context = Context::new();
        let mut topics = Topics { context: context.clone(), channels: BTreeMap::new() };
        for channel in pages.file.channels() {
            topics.of(channel).map_err(Failure::runtime)?;
        }
        let server = WebSocketServer::new()
            .name(format!("parallax {} ({})", run.name().graph, run.name().id))
            .context(&context)
            .message_backlog_size(BACKLOG)
            .bind(arguments.host.clone(), arguments.port)
            .start_blocking();
        let server = server
            .with_context(|| {
                format!("cannot listen at {}:{}; is the port taken?", arguments.host, arguments.port)
            })
            .map_err(Failure::input)?;
        let url = format!("ws://{}:{}", arguments.host, server.port());
        announce(arguments, &run, &url, &topics)?;

        let (mut kept, mut over) = (Instant::now(), None::<Instant>);
        let outcome = loop {
            if over.is_none() && matches!(run.phase(), Phase::Over | Phase::Abandoned) {
                over = Some(Instant::now());
            }
            let mut failed = None;
            pages.turn(&run, &mut |message| match topics.of(message.channel) {
                Ok(channel) => {
                    let time = PartialMetadata { log_time: Some(message.time) };
                    channel.log_with_meta(message.data, time);
                }
                Err(error) => failed = Some(error),
            })?;
            if let Some(error) = failed {
                return Err(Failure::runtime(error));
            }
            if signals.raised() {
                break Outcome::Interrupted;
            }
            // The recorder writes what is left; one that was killed writes nothing more.
            if over.is_some_and(|over| pages.file.ended() || over.elapsed() > LAST) {
                break Outcome::Done;
            }
            if kept.elapsed() > KEEP {
                kept = Instant::now();
                // A run that has just ended is found to have.
                let _ = watch.keep();
            }
            std::thread::sleep(Duration::from_nanos(arguments.interval.unsigned_abs()));
        };
        // Clients get what is queued for them.
        std::thread::sleep(Duration::from_millis(100));
        server.stop().wait_blocking();
        if !arguments.json && outcome == Outcome::Done {
            output::line("the run is over");
        }
        Ok(outcome)
    }

    fn announce(arguments: &Arguments, run: &LiveRun, url: &str, topics: &Topics) -> Result<(), Failure> {
        let name = run.name();
        let topics: Vec<&str> = topics.channels.keys().map(String::as_str).collect();
        if arguments.json {
            return output::json(&Address { url, run: &name.id, graph: &name.graph, topics });
        }
        output::line(format!("{} ({}), {} topics: {url}", name.graph, name.id, topics.len()));
        output::line("in Foxglove: Open connection, Foxglove WebSocket, this address; Ctrl-C ends");
        Ok(())
    }

    /// Where the messages of each topic go.
    struct Topics {
        context: Arc<Context>,
        channels: BTreeMap<String, Arc<RawChannel>>,
    }

    impl Topics {
        fn of(&mut self, channel: &Channel) -> anyhow::Result<&RawChannel> {
            if !self.channels.contains_key(&channel.topic) {
                let definition = channel.definition.clone();
                let schema = Schema::new(channel.schema.clone(), channel.language.clone(), definition);
                let made = ChannelBuilder::new(channel.topic.clone())
                    .context(&self.context)
                    .message_encoding(channel.encoding.clone())
                    .schema(schema)
                    .metadata(channel.metadata.clone())
                    .build_raw()?;
                self.channels.insert(channel.topic.clone(), made);
            }
            self.channels
                .get(&channel.topic)
                .map(|channel| &**channel)
                .ok_or_else(|| anyhow!("no such topic"))
        }
    }

    /// The files of the recording, the one that is being written last.
    struct Pages {
        file: Follow,
        path: PathBuf,
    }

    impl Pages {
        /// The file that is being written, from now on; `None` when somebody does not want to wait for it.
        fn begin(run: &LiveRun, signals: &Signals) -> Result<Option<Self>, Failure> {
            let start = Instant::now();
            loop {
                let files = run.recording().ok_or_else(|| {
                    Failure::input(anyhow!(
                        "the run {} is not recorded here, and what is shown is what is recorded; start it with --out FILE",
                        run.name().id
                    ))
                })?;
                if let Some(path) = files.last() {
                    let mut file = Follow::open(path).runtime()?;
                    file.skip().runtime()?;
                    // The channels are written with the file's first bytes.
                    if file.channels().next().is_some() {
                        return Ok(Some(Self { file, path: path.clone() }));
                    }
                }
                if signals.raised() {
                    return Ok(None);
                }
                if start.elapsed() > PATIENCE || matches!(run.phase(), Phase::Over | Phase::Abandoned) {
                    return Err(Failure::runtime(anyhow!(
                        "the recorder of the run {} writes nothing",
                        run.name().id
                    )));
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        }

        /// Takes what is new, and goes on with the next file where there is one.
        fn turn(&mut self, run: &LiveRun, each: &mut dyn FnMut(Followed<'_>)) -> Result<(), Failure> {
            loop {
                // Looked for first: a file that has a next one then is complete, or its recorder died.
                let files = run.recording().unwrap_or_default();
                self.file.poll(each).runtime()?;
                let place = files.iter().position(|file| *file == self.path);
                let Some(next) = place.and_then(|place| files.get(place + 1)) else { return Ok(()) };
                self.file = Follow::open(next).runtime()?;
                self.path.clone_from(next);
            }
        }
    }
}
