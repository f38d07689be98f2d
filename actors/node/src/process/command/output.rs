//! The standard output and the standard error of a command, as lines of the node's log.
//!
//! Lines are bounded in length and rate. Bytes beyond the rate stay in the pipe, so that a flood slows the program
//! and not the node.

use std::{future::pending, io, time::Duration};

use sinew_model::rate_limiter::{Rate, RateLimiter};
use sinew_runtime::time::Time;
use tokio::{net::unix::pipe::Receiver, time::Instant};

use super::super::spawn::Output;

/// Longest line in bytes; the rest of a longer one is dropped.
const LINE_BYTES_MAX: usize = 1_024;
/// Lines that are written at once, and the time after which one more is. Further lines are dropped and counted.
const LINES_AT_ONCE: u32 = 200;
const LINE_EACH: Duration = Duration::from_millis(10);
/// Bytes that are read in one window of time.
const WINDOW_BYTES: usize = 64 << 10;
const WINDOW: Duration = Duration::from_millis(50);
/// Bytes of one read.
const READ_BYTES: usize = 4_096;

/// Forwards the output of one process.
pub(super) struct OutputReader {
    app: String,
    /// `None` once the process has closed it.
    streams: [Option<Stream>; 2],
    quota: LineQuota,
    window: (Instant, usize),
}

struct Stream {
    name: &'static str,
    pipe: Receiver,
    lines: Lines,
}

impl OutputReader {
    pub(super) fn new(app: &str, output: Option<Output>) -> io::Result<Self> {
        let stream = |name, pipe| {
            Ok::<_, io::Error>(Stream { name, pipe: Receiver::from_owned_fd(pipe)?, lines: Lines::default() })
        };
        let streams = match output {
            Some(Output { stdout, stderr }) => {
                [Some(stream("stdout", stdout)?), Some(stream("stderr", stderr)?)]
            }
            None => [None, None],
        };
        let window = (Instant::now(), 0);
        Ok(Self { app: app.to_owned(), streams, quota: LineQuota::new(), window })
    }

    /// Logs lines that have arrived. Never resolves once the process has closed both streams.
    pub(super) async fn forward(&mut self) {
        if self.window.1 >= WINDOW_BYTES {
            tokio::time::sleep_until(self.window.0 + WINDOW).await;
            self.window = (Instant::now(), 0);
        }
        let at = tokio::select! {
            () = readable(self.streams[0].as_ref()) => 0,
            () = readable(self.streams[1].as_ref()) => 1,
        };
        if self.window.1 == 0 {
            self.window.0 = Instant::now();
        }
        self.window.1 += self.read(at).unwrap_or(0);
    }

    /// Logs what is left after the end of the process, up to the size of the pipes.
    pub(super) fn finish(&mut self) {
        for at in 0..self.streams.len() {
            // A process that has left the group may hold the pipe, and write on.
            let reads = WINDOW_BYTES / READ_BYTES;
            let _ = (0..reads).find(|_| self.read(at).is_none());
            self.close(at);
        }
        if let Some(dropped) = self.quota.take_dropped() {
            sinew_runtime::log::warn!(
                app = self.app,
                dropped,
                "lines of its output were left out: there are too many of them"
            );
        }
    }

    /// Reads from a stream once. Returns the number of bytes; `None` if there are none now.
    fn read(&mut self, at: usize) -> Option<usize> {
        let Self { app, streams, quota, .. } = self;
        let stream = streams[at].as_mut()?;
        let mut bytes = [0; READ_BYTES];
        match stream.pipe.try_read(&mut bytes) {
            Ok(count) if count > 0 => {
                stream.lines.push(&bytes[..count], |line| log_line(app, stream.name, quota, line));
                Some(count)
            }
            Err(cause) if cause.kind() == io::ErrorKind::WouldBlock => None,
            Ok(_) | Err(_) => {
                self.close(at);
                None
            }
        }
    }

    /// Logs the beginning of a line that does not end.
    fn close(&mut self, at: usize) {
        let Self { app, streams, quota, .. } = self;
        if let Some(mut stream) = streams[at].take() {
            stream.lines.finish(|line| log_line(app, stream.name, quota, line));
        }
    }
}

async fn readable(stream: Option<&Stream>) {
    match stream {
        Some(stream) if stream.pipe.readable().await.is_ok() => {}
        Some(_) | None => pending().await,
    }
}

fn log_line(app: &str, stream: &str, quota: &mut LineQuota, line: &str) {
    if let Some(dropped) = quota.take(Time::now()) {
        let dropped = (dropped > 0).then_some(dropped);
        sinew_runtime::log::info!(app, stream, dropped, "{line}");
    }
}

/// The lines that may be written.
struct LineQuota {
    limiter: RateLimiter,
    dropped: u64,
}

impl LineQuota {
    const fn new() -> Self {
        Self { limiter: RateLimiter::new(Rate::new(LINE_EACH, LINES_AT_ONCE)), dropped: 0 }
    }

    /// Returns the number of lines dropped since the last one if one more may be written at `now`. `None`: it must not
    /// be written, and is counted.
    fn take(&mut self, now: Time) -> Option<u64> {
        if self.limiter.try_take(now) {
            return Some(std::mem::take(&mut self.dropped));
        }
        self.dropped += 1;
        None
    }

    /// Returns the number of lines dropped since the last one, if there are any.
    fn take_dropped(&mut self) -> Option<u64> {
        Some(std::mem::take(&mut self.dropped)).filter(|dropped| *dropped > 0)
    }
}

/// Bytes as lines of text. Pure.
#[derive(Default)]
struct Lines {
    line: Vec<u8>,
    /// Whether bytes of the present line were dropped.
    is_cut: bool,
}

impl Lines {
    /// Calls `each` for each line that `bytes` end.
    fn push(&mut self, bytes: &[u8], mut each: impl FnMut(&str)) {
        let mut pieces = bytes.split(|byte| *byte == b'\n');
        let last = pieces.next_back().unwrap_or_default();
        for piece in pieces {
            self.add(piece);
            self.end(&mut each);
        }
        self.add(last);
    }

    /// Calls `each` for the beginning of a line without an end.
    fn finish(&mut self, mut each: impl FnMut(&str)) {
        if !self.line.is_empty() {
            self.end(&mut each);
        }
    }

    fn add(&mut self, piece: &[u8]) {
        let room = LINE_BYTES_MAX - self.line.len();
        self.is_cut |= piece.len() > room;
        self.line.extend_from_slice(&piece[..piece.len().min(room)]);
    }

    fn end(&mut self, each: &mut impl FnMut(&str)) {
        let text = String::from_utf8_lossy(&self.line);
        // A control character could change the terminal of a reader.
        let mut text: String =
            text.trim_end().chars().map(|char| if char.is_control() { ' ' } else { char }).collect();
        if self.is_cut {
            text.push_str("...");
        }
        if !text.is_empty() {
            each(&text);
        }
        self.line.clear();
        self.is_cut = false;
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn lines(pieces: &[&[u8]]) -> Vec<String> {
        let (mut lines, mut found) = (Lines::default(), Vec::new());
        pieces.iter().for_each(|piece| lines.push(piece, |line| found.push(line.to_owned())));
        lines.finish(|line| found.push(line.to_owned()));
        found
    }

    #[test]
    fn lines_are_whole_however_their_bytes_arrive() {
        assert_eq!(lines(&[b"on", b"e\ntwo\n\nthr", b"", b"ee"]), ["one", "two", "three"]);
        assert_eq!(lines(&[b"\x1b[31mred\r\n", b"\xff\n"]), [" [31mred", "\u{fffd}"]);
    }

    #[test]
    fn long_line_is_cut_and_the_next_is_whole() {
        let long = [b'x'; 3 * LINE_BYTES_MAX];
        let found = lines(&[&long, b"y\nnext\n"]);
        assert_eq!(found[0], format!("{}...", "x".repeat(LINE_BYTES_MAX)));
        assert_eq!(found[1..], ["next"]);
        let whole = [b'x'; LINE_BYTES_MAX];
        assert_eq!(lines(&[&whole, b"\n"]), ["x".repeat(LINE_BYTES_MAX)]);
    }

    #[test]
    fn lines_beyond_the_rate_are_counted() {
        let mut quota = LineQuota::new();
        let at = |ms| Time::ZERO + Duration::from_secs(1_000) + Duration::from_millis(ms);
        for _ in 0..LINES_AT_ONCE {
            assert_eq!(quota.take(at(0)), Some(0));
        }
        assert_eq!([quota.take(at(0)), quota.take(at(9)), quota.take(at(10))], [None, None, Some(2)]);
        assert_eq!(quota.take_dropped(), None);
        assert_eq!((quota.take(at(10)), quota.take_dropped()), (None, Some(1)));
    }

    #[test]
    fn output_is_read_to_its_end() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let ((stdout, mut out), (stderr, err)) =
                (io::pipe().expect("a pipe"), io::pipe().expect("a pipe"));
            let output = Output { stdout: stdout.into(), stderr: stderr.into() };
            let mut reader = OutputReader::new("knee", Some(output)).expect("these are pipes");
            out.write_all(b"half a line").expect("it has room");
            reader.forward().await;
            assert_eq!(reader.window.1, 11);
            drop((out, err));
            reader.finish();
            assert!(reader.streams.iter().all(Option::is_none));
        });
    }
}
