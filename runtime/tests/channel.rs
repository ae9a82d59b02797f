//! Channels at their boundary: what goes in comes out, disagreement is refused, nothing stays behind.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::time::{Duration, Instant};

use parallax_runtime::channel::{ChannelError, Endpoint, Listener, Space, Topic, Waker};

fn topic(buffer: usize, subscribers: usize) -> Topic {
    Topic { name: "camera".into(), layout: 0xfeed, words: 3, buffer, subscribers, held: 0 }
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
    let listener = here.listener("agent/wake").unwrap();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let there = Endpoint::new(&space).unwrap();
            let waker = there.waker("agent/wake").unwrap();
            std::thread::sleep(Duration::from_millis(20));
            waker.wake();
        });
        let start = Instant::now();
        listener.wait(Duration::from_secs(10));
        assert!(start.elapsed() < Duration::from_secs(5), "woken, not timed out");
    });
    let start = Instant::now();
    listener.wait(Duration::from_millis(5));
    assert!(start.elapsed() >= Duration::from_millis(4), "without a wake-up the time runs out");
}

#[test]
fn a_call_before_the_wait_ends_it_and_many_calls_lose_none() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    assert!(here.waker("late").is_err(), "a waker needs its listener");
    let listener = here.listener("late").unwrap();
    let waker = here.waker("late").unwrap();
    assert!(!waker.wake(), "nobody sleeps: no system call");
    let start = Instant::now();
    listener.wait(Duration::from_secs(10));
    assert!(start.elapsed() < Duration::from_secs(5), "the call came before the wait and counts");

    // A ball that is passed on: a single call that is lost would leave both waiting until the test is killed.
    let (ping, pong) = (here.listener("ping").unwrap(), here.listener("pong").unwrap());
    let (to_ping, to_pong) = (here.waker("ping").unwrap(), here.waker("pong").unwrap());
    let ball = std::sync::atomic::AtomicU64::new(0);
    let play = |listener: Listener, waker: Waker, parity: u64| {
        use std::sync::atomic::Ordering::SeqCst;
        for turn in (parity..20_000).step_by(2) {
            while ball.load(SeqCst) != turn {
                listener.wait(Duration::from_secs(60));
            }
            ball.store(turn + 1, SeqCst);
            waker.wake();
        }
    };
    std::thread::scope(|scope| {
        let start = Instant::now();
        scope.spawn(|| play(pong, to_ping, 1));
        play(ping, to_pong, 0);
        assert!(start.elapsed() < Duration::from_secs(50), "a call was lost");
    });
}

#[test]
fn a_large_message_is_written_and_read_in_place() {
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let image = Topic { words: 1 << 20, buffer: 2, held: 2, ..topic(2, 1) };
    let publisher = here.create(&image).unwrap().publisher().unwrap();
    let subscriber = here.open(&image).unwrap().subscriber().unwrap();
    let mut places = Vec::new();
    let mut kept = Vec::new();
    // Messages of different lengths, kept beyond the next ones.
    for (number, words) in [(1, 1 << 20), (2, 3)] {
        let mut loan = publisher.loan(words).unwrap();
        assert!(publisher.loan(1).is_err(), "one message is written at a time");
        loan[0] = number;
        loan[words - 1] = 10 * number;
        places.push(loan.len());
        assert_eq!(loan.send().unwrap(), 1);
        kept.push(subscriber.take().unwrap().unwrap());
    }
    assert!(subscriber.take().unwrap().is_none());
    assert_eq!(places, [kept[0].len(), kept[1].len()]);
    assert_eq!((kept[0][0], kept[0][(1 << 20) - 1], kept[1][0], kept[1][2]), (1, 10, 2, 20));
    // A message that goes on being looked at is not overwritten by those that come.
    for _ in 0..8 {
        let mut loan = publisher.loan(3).unwrap();
        loan.fill(9);
        loan.send().unwrap();
    }
    assert_eq!((kept[0][0], kept[1][0]), (1, 2));
    let third = subscriber.take().unwrap().unwrap();
    assert!(subscriber.take().is_err(), "two may be kept, and one looked at");
    drop((kept, third));
    assert_eq!(&*subscriber.take().unwrap().unwrap(), [9, 9, 9]);
    assert!(matches!(publisher.loan((1 << 20) + 1), Err(ChannelError::TooLong { .. })));
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

/// The place in this space's shared memory where these words lie, and the file that holds it.
fn find_words(prefix: &str, wanted: &[u64]) -> (std::path::PathBuf, usize) {
    let bytes: Vec<u8> = wanted.iter().flat_map(|word| word.to_ne_bytes()).collect();
    for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
        if !entry.file_name().to_string_lossy().starts_with(prefix) {
            continue;
        }
        let contents = std::fs::read(entry.path()).unwrap();
        if let Some(at) = contents.windows(bytes.len()).position(|window| window == bytes) {
            return (entry.path(), at);
        }
    }
    panic!("the words are in no segment")
}

#[test]
fn a_length_that_a_sender_makes_up_is_believed_by_nobody() {
    use std::os::unix::fs::FileExt;
    let space = Space::create().unwrap();
    let here = Endpoint::new(&space).unwrap();
    let service = here.create(&topic(4, 1)).unwrap();
    let subscriber = here.open(&topic(4, 1)).unwrap().subscriber().unwrap();
    let publisher = service.publisher().unwrap();
    let marked = [0x1122_3344_5566_7788, 0x99aa_bbcc_ddee_ff00, 0x1357_9bdf_0246_8ace];
    for length in [4, 1 << 20, 1 << 40, u64::MAX / 8, u64::MAX] {
        publisher.send(3, |word| marked[word]).unwrap();
        // Its length stands in the words before it; whoever may write there may write anything.
        let (path, at) = find_words(space.prefix(), &marked);
        let segment = std::fs::File::options().read(true).write(true).open(path).unwrap();
        let word = |place: usize| {
            let mut bytes = [0; 8];
            segment.read_exact_at(&mut bytes, place as u64).unwrap();
            u64::from_ne_bytes(bytes)
        };
        let place = (1..=8).map(|back| at - 8 * back).find(|place| word(*place) == 3);
        let place = place.expect("the length lies before the words");
        segment.write_all_at(&length.to_ne_bytes(), place as u64).unwrap();
        let mut got = None;
        assert!(subscriber.receive(|words| got = Some(words.len())).unwrap());
        assert_eq!(got, Some(0), "a message that says it has {length} words");
        // What it leaves behind harms nobody, and the next message is whole.
        segment.write_all_at(&[0; 24], at as u64).unwrap();
        publisher.send(2, |word| word as u64).unwrap();
        let mut got = Vec::new();
        assert!(subscriber.receive(|words| got.extend_from_slice(words)).unwrap());
        assert_eq!(got, [0, 1]);
    }
}

#[test]
fn a_channel_has_one_sender() {
    let space = Space::create().unwrap();
    let (here, there) = (Endpoint::new(&space).unwrap(), Endpoint::new(&space).unwrap());
    let publisher = here.create(&topic(4, 1)).unwrap().publisher().unwrap();
    let error = there.open(&topic(4, 1)).unwrap().publisher().expect_err("there is one");
    assert!(matches!(&error, ChannelError::Transport { topic, .. } if topic == "camera"), "{error}");
    drop(publisher);
}
