//! A journal with many writers and a slow reader, and one whose writer is killed.
//!
//! `SINEW_SHM_KILLS=300 cargo test --release -p sinew-shm --test journal` for the long form.
#![cfg(target_os = "linux")]

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use sinew_shm::journal::{ChannelKey, Journal, JournalReader, Options, Start};

/// The variable that names the journal of the process that is killed.
const VICTIM: &str = "SINEW_SHM_JOURNAL";
const THREADS: u64 = 6;

fn path(name: &str) -> PathBuf {
    // In memory, as a node has it.
    let folder = Path::new("/dev/shm");
    let folder = if folder.is_dir() { folder.to_owned() } else { std::env::temp_dir() };
    folder.join(format!("sinew-test-{name}-{}.journal", std::process::id()))
}

fn create(path: &Path) -> Journal {
    Journal::create(path, &Options { ring_bytes: 256 * 1024, ..Options::default() }).expect("it is made")
}

/// Writes the message with this number of one thread: its length and all of its bytes follow from both.
fn write(journal: &Journal, thread: u64, number: u64) {
    let length = (number * 37 % 900) as usize;
    let bytes = [number as u8; 900];
    journal.write(ChannelKey([thread, 0, 0]), number, &[&thread.to_ne_bytes(), &bytes[..length]]);
}

/// Checks a record, and returns its thread.
fn check(number: u64, time: u64, payload: &[u8]) -> u64 {
    assert_eq!(
        number, time,
        "each thread has a channel of its own, and numbers its messages as the channel does"
    );
    let (thread, bytes) = payload.split_at(8);
    assert_eq!(bytes.len(), (number * 37 % 900) as usize);
    assert!(bytes.iter().all(|byte| *byte == number as u8), "message {number} is mixed with another one");
    u64::from_ne_bytes(thread.try_into().expect("eight bytes"))
}

/// Any loss is counted: for each channel, all that was seen was read or missed.
#[test]
fn many_writers_lose_nothing_uncounted() {
    let path = path("stress");
    let journal = create(&path);
    let is_over = AtomicBool::new(false);
    let messages = 40_000;
    let mut reader = JournalReader::open(&path, Start::Oldest).expect("it is there");
    reader.set_patience(Duration::from_millis(20));
    std::thread::scope(|scope| {
        let writers: Vec<_> = (0..THREADS)
            .map(|thread| {
                let journal = &journal;
                scope.spawn(move || (1..=messages).for_each(|number| write(journal, thread, number)))
            })
            .collect();
        let (is_over, reader) = (&is_over, &mut reader);
        scope.spawn(move || drain(reader, is_over));
        writers.into_iter().for_each(|writer| writer.join().expect("it ends"));
        is_over.store(true, Ordering::Release);
    });
    let channels = reader.channels().expect("it is there");
    assert_eq!(channels.len() as u64, THREADS);
    let mut read = 0;
    for channel in channels {
        assert_eq!(channel.seen, messages);
        let tally = channel.tally;
        read += tally.read;
        let (before, after) = (tally.first.saturating_sub(1), channel.seen - tally.last);
        assert_eq!(tally.read + tally.missed() + before + after, channel.seen);
    }
    println!("{read} of {} read; {:?}", THREADS * messages, reader.counts());
    assert!(read > 0);
    std::fs::remove_file(path).expect("it is there");
}

/// While the ring is longer than all records, none is lost, whatever the order of the threads.
#[test]
fn ring_that_has_room_keeps_every_record() {
    let path = path("room");
    let journal =
        Journal::create(&path, &Options { ring_bytes: 32 << 20, ..Options::default() }).expect("it is made");
    let messages = 5_000;
    std::thread::scope(|scope| {
        for thread in 0..THREADS {
            let journal = &journal;
            scope.spawn(move || (1..=messages).for_each(|number| write(journal, thread, number)));
        }
    });
    let mut reader = JournalReader::open(&path, Start::Oldest).expect("it is there");
    let mut payload = Vec::new();
    let mut seen = vec![0; messages as usize * THREADS as usize];
    while let Some(record) = reader.next(0, &mut payload).expect("it is whole") {
        let thread = check(record.number, record.time, &payload);
        seen[(thread * messages + record.number - 1) as usize] += 1;
    }
    assert!(seen.iter().all(|count| *count == 1));
    assert_eq!(reader.counts(), sinew_shm::journal::ReaderCounts::default());
    std::fs::remove_file(path).expect("it is there");
}

fn drain(reader: &mut JournalReader, is_over: &AtomicBool) {
    let (began, mut payload) = (Instant::now(), Vec::new());
    // A writer that hangs must not keep the test.
    while began.elapsed() < Duration::from_secs(120) {
        let is_last = is_over.load(Ordering::Acquire);
        let now = began.elapsed().as_nanos() as u64;
        while let Some(record) = reader.next(now, &mut payload).expect("it is whole") {
            let thread = check(record.number, record.time, &payload);
            assert!(thread < THREADS);
        }
        if is_last {
            return;
        }
    }
}

#[test]
#[ignore = "the other process of this test, started by it"]
fn the_other_process() {
    let Some(path) = std::env::var_os(VICTIM) else { return };
    let journal = create(Path::new(&path));
    println!("ready");
    std::thread::scope(|scope| {
        for thread in 0..THREADS {
            let journal = &journal;
            scope.spawn(move || (1..u64::MAX).for_each(|number| write(journal, thread, number)));
        }
    });
}

/// The last records of a process that was killed are there, and each is whole.
#[test]
fn killed_writer_leaves_its_last_records() {
    let kills: u64 = std::env::var("SINEW_SHM_KILLS").map_or(10, |kills| kills.parse().expect("a number"));
    let path = path("kill");
    for kill in 0..kills {
        one_kill(&path, kill);
    }
    std::fs::remove_file(path).expect("it is there");
}

fn one_kill(path: &Path, kill: u64) {
    let program = std::env::current_exe().expect("it has a path");
    let mut victim = Command::new(program)
        .args(["--ignored", "--exact", "the_other_process", "--nocapture"])
        .env(VICTIM, path)
        .stdout(Stdio::piped())
        .spawn()
        .expect("it starts");
    let mut reader = loop {
        // The previous victim's file is replaced when this one's is complete.
        match JournalReader::open(path, Start::Oldest) {
            Ok(reader) if reader.writer() == victim.id() => break reader,
            _ => std::thread::yield_now(),
        }
        assert!(victim.try_wait().expect("it is ours").is_none(), "it has ended by itself");
    };
    assert!(reader.is_writer_alive());
    // More than the ring, and the instant differs each time.
    let enough = 300 * 1024 + kill * 4_321;
    let mut payload = Vec::new();
    let began = Instant::now();
    let mut position = 0;
    while position < enough {
        assert!(began.elapsed() < Duration::from_secs(60), "it writes");
        position =
            reader.next(0, &mut payload).expect("it is whole").map_or(position, |record| record.position);
    }
    victim.kill().expect("it is ours");
    victim.wait().expect("it is ours");
    let mut dead = JournalReader::open(path, Start::Oldest).expect("it is there");
    assert!(!dead.is_writer_alive() && !dead.is_closed().expect("it is there"));
    let mut last = BTreeMap::new();
    let mut bytes = 0;
    while let Some(record) = dead.next(0, &mut payload).expect("it is whole") {
        last.insert(check(record.number, record.time, &payload), record.number);
        bytes += payload.len();
    }
    let counts = dead.counts();
    assert!(bytes > 100 * 1024, "most of the ring is there: {bytes} bytes, {counts:?}");
    // At most one half record of each thread, and one that each of them may have damaged before.
    assert!(counts.unfinished <= THREADS && counts.damaged <= THREADS, "{counts:?}");
    for channel in dead.channels().expect("it is there") {
        let thread = channel.key.expect("it has a place").0[0];
        // A thread that the system has not let run for a whole turn has no record.
        let Some(last) = last.get(&thread) else { continue };
        let missed = channel.seen - last;
        assert!(missed <= 1 + counts.damaged, "thread {thread}: seen {}, last {last}", channel.seen);
    }
}
