//! The log's thread, and the bounded queue to it.

use std::{
    io::stderr,
    mem::MaybeUninit,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicU64, AtomicUsize, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::{FileType, fstat},
    io::Errno,
};

/// Maximum number of lines that wait to be written. Further ones are dropped and counted.
const QUEUE_MAX: usize = 256;
/// Maximum length of a line in bytes; the rest is cut off.
const LINE_BYTES_MAX: usize = 4 * 1024;
/// Time for a blocked standard error to accept data.
const STDERR_TIMEOUT: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
/// Time between two checks whether all lines are written.
const POLL_INTERVAL: Duration = Duration::from_millis(1);

/// Passes lines to a thread that writes them. When this is dropped, the thread writes the queued lines and
/// ends.
pub(super) struct Lines {
    queue: SyncSender<Vec<u8>>,
    counts: Arc<Counts>,
}

#[derive(Default)]
struct Counts {
    /// Lines not written yet.
    waiting: AtomicUsize,
    /// Lines dropped so far.
    lost: AtomicU64,
}

impl Lines {
    /// Starts the thread; `None` if the system cannot create one. All signals are blocked in it: those are
    /// the program's.
    pub(super) fn start(write: impl FnMut(&[u8]) + Send + 'static) -> Option<Self> {
        let (queue, lines) = sync_channel(QUEUE_MAX);
        let counts = Arc::new(Counts::default());
        let thread_counts = counts.clone();
        let thread = thread::Builder::new().name("sinew-log".to_owned());
        let started = without_signals(|| thread.spawn(move || work(&lines, &thread_counts, write)));
        started.ok().map(|_| Self { queue, counts })
    }

    /// Queues a line if there is room. Never waits.
    pub(super) fn push(&self, line: &[u8]) {
        let line = if line.len() > LINE_BYTES_MAX {
            [&line[..LINE_BYTES_MAX - 1], b"\n"].concat()
        } else {
            line.to_vec()
        };
        self.counts.waiting.fetch_add(1, Ordering::Relaxed);
        if self.queue.try_send(line).is_err() {
            self.counts.waiting.fetch_sub(1, Ordering::Relaxed);
            self.counts.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Whether any line is not written yet.
    pub(super) fn are_waiting(&self) -> bool {
        self.counts.waiting.load(Ordering::Relaxed) > 0
    }

    /// Waits until all lines are written, at most for `within`.
    pub(super) fn flush(&self, within: Duration) {
        let until = Instant::now() + within;
        while self.are_waiting() && Instant::now() < until {
            thread::sleep(POLL_INTERVAL);
        }
    }
}

fn work(lines: &Receiver<Vec<u8>>, counts: &Counts, mut write: impl FnMut(&[u8])) {
    use_normal_schedule();
    let mut reported = 0;
    for line in lines {
        write(&line);
        let lost = counts.lost.load(Ordering::Relaxed);
        let new = lost - std::mem::replace(&mut reported, lost);
        if new > 0 {
            let line =
                format!("sinew: the standard error was blocked for a while; {new} lines are missing\n");
            write(line.as_bytes());
        }
        counts.waiting.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The file behind the standard error at the library's first check; `None` if it is closed or not known.
static FIRST: OnceLock<Option<(u64, u64)>> = OnceLock::new();

/// Records which file the standard error is. The library opens no file before this.
pub(super) fn record_stderr() {
    FIRST.get_or_init(|| fstat(stderr()).ok().map(|file| (file.st_dev, file.st_ino)));
}

/// Whether the standard error may be written to. If the program has closed it, another file may have its
/// number by now, such as the library's own socket to the node, or its shared memory. So the library writes
/// only to the file that it found at first, or to a terminal, a pipe or a named file that the program has put
/// there since.
fn is_writable() -> bool {
    let Some(first) = FIRST.get().copied().flatten() else { return false };
    fstat(stderr()).is_ok_and(|file| match FileType::from_raw_mode(file.st_mode) {
        _ if (file.st_dev, file.st_ino) == first => true,
        FileType::CharacterDevice | FileType::Fifo => true,
        FileType::RegularFile => file.st_nlink > 0,
        FileType::Directory
        | FileType::Symlink
        | FileType::Socket
        | FileType::BlockDevice
        | FileType::Unknown => false,
    })
}

/// Writes the whole line, however long that takes, without the lock that Rust's own writers to standard error
/// share.
pub(super) fn to_stderr(line: &[u8]) {
    let mut rest = line;
    while !rest.is_empty() && is_writable() {
        match rustix::io::write(stderr(), rest) {
            Ok(0) => return,
            Ok(count) => rest = &rest[count..],
            Err(Errno::INTR) => {}
            // The program has made it non-blocking.
            Err(Errno::AGAIN) => _ = poll(&mut [PollFd::new(&stderr(), PollFlags::OUT)], None),
            // There is no standard error.
            Err(_) => return,
        }
    }
}

/// Whether the standard error accepts data, now or soon.
pub(super) fn accepts_data() -> bool {
    poll(&mut [PollFd::new(&stderr(), PollFlags::OUT)], Some(&STDERR_TIMEOUT)) != Ok(0)
}

/// Runs `start` with all signals blocked in the calling thread. A thread that `start` creates inherits the
/// mask.
pub(crate) fn without_signals<R>(start: impl FnOnce() -> R) -> R {
    let mut all = MaybeUninit::uninit();
    let mut before = MaybeUninit::uninit();
    // SAFETY: it writes the whole set. It does not fail.
    unsafe { libc::sigfillset(all.as_mut_ptr()) };
    // SAFETY: the first set was written above; the second has room for the previous mask.
    let blocked = unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, all.as_ptr(), before.as_mut_ptr()) };
    let started = start();
    if blocked == 0 {
        // SAFETY: the call above has written this set.
        unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, before.as_ptr(), std::ptr::null_mut()) };
    }
    started
}

/// Gives the calling thread the normal schedule: the thread that logs first may have a real-time priority.
fn use_normal_schedule() {
    #[cfg(target_os = "linux")]
    {
        let none = libc::sched_param { sched_priority: 0 };
        // SAFETY: it reads the struct. 0 is the calling thread, which continues unchanged if the call fails.
        unsafe { libc::sched_setscheduler(0, libc::SCHED_OTHER, &raw const none) };
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Time limit for events that must occur.
    const WATCHDOG: Duration = Duration::from_secs(60);

    #[test]
    fn blocked_writer_blocks_no_caller_and_losses_are_counted() {
        // given: a writer that blocks
        let (release, released) = sync_channel::<()>(0);
        let (begins, begun) = sync_channel(1);
        let written = Arc::new(Mutex::new(Vec::new()));
        let thread_written = written.clone();
        let lines = Lines::start(move |line| {
            let _ = begins.try_send(());
            // Blocks until the sender is dropped.
            let _ = released.recv_timeout(WATCHDOG);
            thread_written.lock().expect("nobody panics").push(String::from_utf8_lossy(line).into_owned());
        });
        let lines = lines.expect("a thread");
        lines.push(b"0\n");
        begun.recv_timeout(WATCHDOG).expect("the thread starts to write");

        // when: more lines are logged than the queue holds
        (1..=QUEUE_MAX + 3).for_each(|number| lines.push(format!("{number}\n").as_bytes()));

        // then
        drop(release);
        lines.flush(WATCHDOG);
        let written = written.lock().expect("nobody panics");
        assert_eq!(written.len(), QUEUE_MAX + 2, "{written:?}");
        assert!(written[1].contains("3 lines are missing"), "{written:?}");
        assert_eq!(written.last(), Some(&format!("{QUEUE_MAX}\n")));
    }

    #[test]
    fn long_line_is_cut_off() {
        let (send, written) = sync_channel(1);
        let lines = Lines::start(move |line| _ = send.send(line.to_vec())).expect("a thread");
        lines.push(&[b'x'; 2 * LINE_BYTES_MAX]);
        let line = written.recv_timeout(WATCHDOG).expect("a line");
        assert_eq!((line.len(), line.last()), (LINE_BYTES_MAX, Some(&b'\n')));
    }
}
