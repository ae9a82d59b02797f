//! Channels at their boundary: what goes in comes out, disagreement is refused, nothing stays behind.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::time::{Duration, Instant};

use parallax_runtime::channel::{ChannelError, Endpoint, Space, Topic};

fn topic(buffer: usize, subscribers: usize) -> Topic {
    Topic { name: "camera".into(), layout: 0xfeed, words: 3, buffer, subscribers }
}

/// Everything of this space that shared memory shows.
fn remains(space: &str, prefix: &str) -> Vec<String> {
    let mut found: Vec<String> = std::fs::read_dir("/dev/shm")
        .unwrap()
        .flatten()
        .map(|e| e.file_name().to_string_lossy().into_owned())
        .filter(|name| name.starts_with(prefix))
        .collect();
    if std::path::Path::new(space).exists() {
        found.push(space.into());
    }
    found
}

#[test]
fn messages_arrive_in_order_and_the_oldest_give_way() {
    let space = Space::create().unwrap();
    let (sender, receiver) = (Endpoint::new(&space).unwrap(), Endpoint::new(&space).unwrap());
    let service = sender.create(&topic(4, 1)).unwrap();
    let subscriber = receiver.open(&topic(4, 1)).unwrap().subscriber().unwrap();
    let publisher = service.publisher().unwrap();
    assert_eq!(publisher.connect().unwrap(), 1);
    for seq in 0..10 {
        assert_eq!(
            publisher.send(2, |i| seq * 10 + i as u64).unwrap(),
            1,
            "every message counts its receivers"
        );
    }
    let mut got = Vec::new();
    while subscriber.receive(|words| got.push(words.to_vec())).unwrap() {}
    let newest: Vec<Vec<u64>> = (6..10).map(|seq| vec![seq * 10, seq * 10 + 1]).collect();
    assert_eq!(got, newest);
}

#[test]
fn nobody_listens_is_told() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let publisher = here.create(&topic(4, 1)).unwrap().publisher().unwrap();
    assert_eq!(publisher.send(1, |_| 0).unwrap(), 0);
    let subscriber = here.open(&topic(4, 1)).unwrap().subscriber().unwrap();
    assert_eq!(publisher.send(1, |_| 5).unwrap(), 1);
    drop(subscriber);
    assert_eq!(publisher.send(1, |_| 6).unwrap(), 0);
}

#[test]
fn another_layout_is_refused_by_name() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let _service = here.create(&topic(4, 1)).unwrap();
    let error = here.open(&Topic { layout: 0xbeef, ..topic(4, 1) }).expect_err("the hashes differ");
    assert!(
        matches!(&error, ChannelError::Layout { topic, expected: 0xbeef } if topic == "camera"),
        "{error}"
    );
    // The same leaves in another number are another layout too.
    let error = here.open(&Topic { words: 9, ..topic(4, 1) }).expect_err("the lengths differ");
    assert!(matches!(error, ChannelError::Layout { .. }), "{error}");
}

#[test]
fn a_message_that_is_too_long_is_refused() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let publisher = here.create(&topic(4, 1)).unwrap().publisher().unwrap();
    let error = publisher.send(4, |_| 0).expect_err("three words fit");
    assert!(matches!(error, ChannelError::TooLong { words: 4, limit: 3, .. }), "{error}");
}

#[test]
fn two_runs_do_not_meet() {
    let (one, two) = (Space::create().unwrap(), Space::create().unwrap());
    let (first, second) = (Endpoint::new(&one).unwrap(), Endpoint::new(&two).unwrap());
    let publisher = first.create(&topic(4, 1)).unwrap().publisher().unwrap();
    assert!(second.open(&topic(4, 1)).is_err(), "the other run's channel must not be visible");
    let subscriber = second.create(&topic(4, 1)).unwrap().subscriber().unwrap();
    assert_eq!(publisher.send(1, |_| 1).unwrap(), 0);
    assert!(!subscriber.receive(|_| {}).unwrap());
}

#[test]
fn a_waker_ends_a_wait() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let listener = here.listener("agent/wake", 1).unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let there = Endpoint::new(&space).unwrap();
            let waker = there.waker("agent/wake").unwrap();
            std::thread::sleep(Duration::from_millis(20));
            assert_eq!(waker.wake().unwrap(), 1);
        });
        let start = Instant::now();
        listener.wait(Duration::from_secs(10)).unwrap();
        assert!(start.elapsed() < Duration::from_secs(5), "woken, not timed out");
    });
    let start = Instant::now();
    listener.wait(Duration::from_millis(5)).unwrap();
    assert!(start.elapsed() >= Duration::from_millis(4), "without a wake-up the time runs out");
}

#[test]
fn nothing_stays_behind() {
    let space = Space::create().unwrap();
    let (path, prefix) = (space.path().display().to_string(), space.prefix().to_owned());
    let here = Endpoint::new(&space).unwrap();
    let publisher = here.create(&topic(4, 1)).unwrap().publisher().unwrap();
    publisher.send(1, |_| 0).unwrap();
    assert!(remains(&path, &prefix).len() > 1, "the test must look where the segments are");
    // As if the process had been killed: the ports never run their own clean-up.
    std::mem::forget((publisher, here));
    drop(space);
    assert_eq!(remains(&path, &prefix), Vec::<String>::new());
}
