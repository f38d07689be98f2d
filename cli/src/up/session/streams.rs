//! The standard streams of a program: written, and read line by line, each with a deadline.

use std::{
    fs::File,
    io::{self, BufRead as _, BufReader, Read, Write as _},
    process::{Child, ChildStdin, Command, Stdio},
    sync::{
        Arc, Mutex, PoisonError,
        mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use rustix::process::{Pid, PidfdFlags, pidfd_open};

use super::super::{ended::has_ended, protocol::LINE_BYTES_MAX};

/// Maximum number of writes that wait: a request and the content behind it.
const WRITES_MAX: usize = 4;
/// Maximum number of lines that wait: one answer is asked for at a time.
const LINES_MAX: usize = 4;
/// Bytes of standard error that are kept.
const WORDS_BYTES_MAX: usize = 4 << 10;
/// Time limit for the program to end after its input, and for its last words.
const ENDS_WITHIN: Duration = Duration::from_secs(2);

/// A write to the program.
pub(super) enum Written {
    Line(Vec<u8>),
    /// So many bytes of a file.
    File(File, u64),
}

/// A running program. It ends with this value.
#[derive(Debug)]
pub(super) struct Streams {
    child: Child,
    input: Option<SyncSender<Written>>,
    lines: Receiver<Vec<u8>>,
    words: Arc<Mutex<Vec<u8>>>,
    /// Closed at the end of standard error.
    words_end: Receiver<()>,
}

impl Streams {
    /// Starts a program with pipes.
    pub(super) fn start(command: &mut Command) -> io::Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn()?;
        let pipes = (child.stdin.take(), child.stdout.take(), child.stderr.take());
        let (Some(stdin), Some(stdout), Some(stderr)) = pipes else {
            return Err(io::Error::other("the program has no pipes"));
        };
        let (input, writes) = sync_channel(WRITES_MAX);
        thread::spawn(move || write_all(stdin, &writes));
        let (line, lines) = sync_channel(LINES_MAX);
        thread::spawn(move || read_lines(stdout, &line));
        let words = Arc::new(Mutex::new(Vec::new()));
        let (end, words_end) = sync_channel(0);
        let kept = words.clone();
        thread::spawn(move || {
            read_words(stderr, &kept);
            drop(end);
        });
        Ok(Self { child, input: Some(input), lines, words, words_end })
    }

    /// Writes to the program, without waiting for it.
    ///
    /// # Errors
    /// It does not read any more.
    pub(super) fn write(&self, written: Written) -> Result<(), io::Error> {
        let sent = self.input.as_ref().map(|input| input.try_send(written));
        match sent {
            Some(Ok(())) => Ok(()),
            Some(Err(_)) | None => Err(io::ErrorKind::BrokenPipe.into()),
        }
    }

    /// Closes its standard input, once all is written.
    pub(super) fn close_input(&mut self) {
        self.input = None;
    }

    /// Returns its next line. A program without one in time is ended.
    pub(super) fn line(&mut self, within: Duration) -> Result<Vec<u8>, String> {
        match self.lines.recv_timeout(within) {
            Ok(line) => Ok(line),
            Err(RecvTimeoutError::Disconnected) => Err("the connection has ended".to_owned()),
            Err(RecvTimeoutError::Timeout) => {
                // It may have ended meanwhile.
                let _ = self.child.kill();
                Err(format!("no answer within {within:?}"))
            }
        }
    }

    /// Waits for the program's end. Returns its exit code; `None` if there is none in time.
    pub(super) fn wait(&mut self, within: Duration) -> Option<i32> {
        if let Ok(Some(status)) = self.child.try_wait() {
            return status.code();
        }
        let handle = pidfd_open(Pid::from_child(&self.child), PidfdFlags::empty()).ok()?;
        if has_ended(&handle, within).ok()? { self.child.wait().ok()?.code() } else { None }
    }

    /// Returns its standard error so far; all of it, if it ends in time.
    pub(super) fn words(&self) -> String {
        // An error is the end, or the time.
        let _ = self.words_end.recv_timeout(ENDS_WITHIN);
        let words = self.words.lock().unwrap_or_else(PoisonError::into_inner);
        String::from_utf8_lossy(&words).trim().to_owned()
    }
}

impl Drop for Streams {
    fn drop(&mut self) {
        self.close_input();
        if self.wait(ENDS_WITHIN).is_none() {
            // It may have ended meanwhile.
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

fn write_all(mut stdin: ChildStdin, writes: &Receiver<Written>) {
    for written in writes {
        let done = match written {
            Written::Line(line) => stdin.write_all(&line),
            Written::File(file, bytes) => io::copy(&mut file.take(bytes), &mut stdin).map(drop),
        };
        // The end of the program is seen by its output.
        if done.and_then(|()| stdin.flush()).is_err() {
            return;
        }
    }
}

fn read_lines(stdout: impl Read, lines: &SyncSender<Vec<u8>>) {
    let mut stdout = BufReader::new(stdout);
    loop {
        let mut line = Vec::new();
        let read = (&mut stdout).take(LINE_BYTES_MAX).read_until(b'\n', &mut line);
        if read.is_err() || line.is_empty() || lines.send(line).is_err() {
            return;
        }
    }
}

fn read_words(mut stderr: impl Read, words: &Mutex<Vec<u8>>) {
    let mut block = [0; 1_024];
    while let Ok(read @ 1..) = stderr.read(&mut block) {
        let mut words = words.lock().unwrap_or_else(PoisonError::into_inner);
        let room = WORDS_BYTES_MAX.saturating_sub(words.len());
        words.extend_from_slice(&block[..read.min(room)]);
    }
}
