//! `parallax live` as Foxglove sees it: a client of its WebSocket protocol reads a running graph, and what it reads is what
//! is recorded.
//!
//! The protocol: github.com/foxglove/ws-protocol, spec.md.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod live;

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read};
use std::net::TcpStream;
use std::process::{Child, Stdio};

use live::{parallax, start, under_way};
use parallax::runtime::recording::Recording;
use parallax::runtime::recording::follow::Follow;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// A viewer's server that does not outlive its test.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts `parallax live`; gives what it prints, as JSON.
fn serve(run: &str, more: &[&str]) -> (Server, Value) {
    let mut command = parallax(&["live", run, "--port", "0", "--json"]);
    let mut server =
        Server(command.args(more).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    let mut text = String::new();
    let mut lines = BufReader::new(server.0.stdout.take().unwrap()).lines();
    while serde_json::from_str::<Value>(&text).is_err() {
        let Some(line) = lines.next() else {
            let mut errors = String::new();
            server.0.stderr.take().unwrap().read_to_string(&mut errors).unwrap();
            panic!("it printed {text}, and {errors}");
        };
        text += &line.unwrap();
    }
    let printed = serde_json::from_str(&text).unwrap();
    (server, printed)
}

fn connect(url: &str) -> WebSocket<TcpStream> {
    let mut request = url.into_client_request().unwrap();
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
    let stream = TcpStream::connect(url.strip_prefix("ws://").unwrap()).unwrap();
    stream.set_read_timeout(Some(std::time::Duration::from_secs(30))).unwrap();
    let (socket, answer) = tungstenite::client(request, stream).unwrap();
    assert_eq!(answer.headers()["sec-websocket-protocol"], "foxglove.sdk.v1");
    socket
}

/// The next text of this operation.
fn text(socket: &mut WebSocket<TcpStream>, operation: &str) -> Value {
    loop {
        if let Message::Text(text) = socket.read().unwrap() {
            let value: Value = serde_json::from_str(&text).unwrap();
            if value["op"] == operation {
                return value;
            }
        }
    }
}

/// The next message: of which subscription, its time and its bytes.
fn data(socket: &mut WebSocket<TcpStream>) -> Option<(u32, u64, Vec<u8>)> {
    loop {
        match socket.read() {
            Ok(Message::Binary(bytes)) if bytes[0] == 1 => {
                let subscription = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                let time = u64::from_le_bytes(bytes[5..13].try_into().unwrap());
                return Some((subscription, time, bytes[13..].to_vec()));
            }
            Ok(Message::Close(_)) | Err(_) => return None,
            Ok(_) => {}
        }
    }
}

#[test]
fn foxglove_sees_what_is_recorded_while_it_happens() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run.mcap");
    // In files of a second each, so that it has to go on from one to the next.
    let (run, name) =
        start("pendulum", &["--out", out.to_str().unwrap(), "--duration", "30", "--rotate", "1s"]);
    under_way(&name);
    let (server, printed) = serve(&name, &[]);
    let url = printed["url"].as_str().unwrap();
    assert!(url.starts_with("ws://127.0.0.1:"), "{url}");
    let mut socket = connect(url);
    let info = text(&mut socket, "serverInfo");
    assert!(info["name"].as_str().unwrap().contains("pendulum"), "{info}");
    let advertised = text(&mut socket, "advertise");
    let channels: BTreeMap<&str, &Value> = advertised["channels"]
        .as_array()
        .unwrap()
        .iter()
        .map(|channel| (channel["topic"].as_str().unwrap(), channel))
        .collect();
    let topics: Vec<&str> =
        printed["topics"].as_array().unwrap().iter().map(|t| t.as_str().unwrap()).collect();
    assert_eq!(channels.keys().copied().collect::<Vec<_>>(), topics);
    for topic in ["/world", "/camera", "/estimator", "/agent", "/motor", "/agent/steps", "/parallax/faults"] {
        let channel = channels[topic];
        assert_eq!((&channel["encoding"], &channel["schemaEncoding"]), (&json!("cdr"), &json!("ros2msg")));
    }
    let schema = channels["/motor"]["schema"].as_str().unwrap();
    assert!(schema.contains("float64 voltage"), "{schema}");

    let wanted = ["/motor", "/camera/steps"];
    let subscriptions: Vec<Value> = wanted
        .iter()
        .enumerate()
        .map(|(id, topic)| json!({ "id": id, "channelId": channels[topic]["id"] }))
        .collect();
    let subscribe = json!({ "op": "subscribe", "subscriptions": subscriptions }).to_string();
    socket.send(Message::Text(subscribe.into())).unwrap();
    let mut seen: Vec<(u32, u64, Vec<u8>)> = Vec::new();
    // Three seconds of the run, and so two ends of files.
    while seen.last().is_none_or(|last| last.1 < seen[0].1 + 3_000_000_000) {
        seen.push(data(&mut socket).expect("the run goes on"));
    }
    // What is shown is young: the run has not ended.
    run.interrupt();
    while let Some(message) = data(&mut socket) {
        seen.push(message);
    }
    let report = run.finish();
    drop(server);

    let mut recorded: BTreeMap<(u32, u64), Vec<u8>> = BTreeMap::new();
    let files = report.recording.expect("it is recorded").files;
    assert!(files.len() > 2, "{files:?}");
    for file in &files {
        let mut follow = Follow::open(file).unwrap();
        let mut keep = |message: parallax::runtime::recording::follow::Followed<'_>| {
            if let Some(id) = wanted.iter().position(|topic| *topic == message.channel.topic) {
                recorded.insert((id as u32, message.time), message.data.to_vec());
            }
        };
        follow.poll(&mut keep).unwrap();
        assert!(follow.ended(), "{}", file.display());
    }
    for (id, time, bytes) in &seen {
        assert_eq!(recorded.get(&(*id, *time)), Some(bytes), "{} at {time} ns", wanted[*id as usize]);
    }
    // From the first one on, nothing is missing.
    for id in 0..2 {
        let times = |mut times: Vec<u64>| {
            times.sort_unstable();
            times
        };
        let shown = times(seen.iter().filter(|(of, ..)| *of == id).map(|(_, time, _)| *time).collect());
        assert!(shown.len() > 50, "{} of {}", shown.len(), wanted[id as usize]);
        let all: Vec<u64> = recorded
            .keys()
            .filter(|(of, time)| *of == id && *time >= shown[0])
            .map(|(_, time)| *time)
            .collect();
        assert_eq!(shown, all);
    }
    // The numbers are those of the recording: the leaves come last. The last file may be younger than the last message.
    let parts = files.iter().map(|file| Recording::read(file).unwrap());
    let last = parts.filter_map(|part| part.node("motor")?.messages.last().cloned()).next_back().unwrap();
    let (.., bytes) = seen.iter().find(|(id, time, _)| *id == 0 && *time as i64 == last.sent).unwrap();
    let voltage = f64::from_le_bytes(bytes[bytes.len() - 8..].try_into().unwrap());
    assert_eq!(Some(&voltage), last.payload.last());
}

#[test]
fn a_run_that_is_not_recorded_cannot_be_shown() {
    let (run, name) = start("pendulum", &["--duration", "30"]);
    under_way(&name);
    let output = parallax(&["live", &name, "--port", "0"]).output().unwrap();
    let refusal = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{refusal}");
    assert!(refusal.contains("is not recorded") && refusal.contains("--out"), "{refusal}");
    run.interrupt();
    run.finish();
}
