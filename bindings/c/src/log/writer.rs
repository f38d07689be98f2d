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

/// Lines that wait to be written at most. What comes then is dropped and counted.
const QUEUE_MAX: usize = 256;
/// Bytes of a line at most; the rest is left out.
const LINE_BYTES_MAX: usize = 4 * 1024;
/// Time for a standard error that takes nothing to take something after all.
const PATIENCE: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
/// Time between two looks whether all is written.
const PACE: Duration = Duration::from_millis(1);

/// Lines to a thread that writes them. The thread ends when this is dropped, after what it was given.
pub(super) struct Lines {
    queue: SyncSender<Vec<u8>>,
    counts: Arc<Counts>,
}

#[derive(Default)]
struct Counts {
    /// Lines that are not written yet.
    waiting: AtomicUsize,
    /// Lines that were dropped so far.
    lost: AtomicU64,
}

impl Lines {
    /// Starts the thread; `None` if the system gives none. It takes no signals: those are the program's.
    pub(super) fn begin(write: impl FnMut(&[u8]) + Send + 'static) -> Option<Self> {
        let (queue, lines) = sync_channel(QUEUE_MAX);
        let counts = Arc::new(Counts::default());
        let its_counts = counts.clone();
        let thread = thread::Builder::new().name("sinew-log".to_owned());
        let started = without_signals(|| thread.spawn(move || work(&lines, &its_counts, write)));
        started.ok().map(|_| Self { queue, counts })
    }

    /// Puts a line at the end of the queue, if there is room. Never waits.
    pub(super) fn enter(&self, line: &[u8]) {
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

    /// Whether something is not written yet.
    pub(super) fn are_waiting(&self) -> bool {
        self.counts.waiting.load(Ordering::Relaxed) > 0
    }

    /// Waits until all is written, and no longer than this.
    pub(super) fn flush(&self, within: Duration) {
        let until = Instant::now() + within;
        while self.are_waiting() && Instant::now() < until {
            thread::sleep(PACE);
        }
    }
}

fn work(lines: &Receiver<Vec<u8>>, counts: &Counts, mut write: impl FnMut(&[u8])) {
    make_ordinary();
    let mut said = 0;
    for line in lines {
        write(&line);
        let lost = counts.lost.load(Ordering::Relaxed);
        let new = lost - std::mem::replace(&mut said, lost);
        if new > 0 {
            let words =
                format!("sinew: the standard error took nothing for a while; {new} lines are missing\n");
            write(words.as_bytes());
        }
        counts.waiting.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Which file the standard error is when the library looks first; `None`: it is closed, or not known.
static FIRST: OnceLock<Option<(u64, u64)>> = OnceLock::new();

/// Looks which file the standard error is. Before that the library opens none.
pub(super) fn look_at_stderr() {
    FIRST.get_or_init(|| fstat(stderr()).ok().map(|file| (file.st_dev, file.st_ino)));
}

/// Whether the standard error may be written to. Where the program has closed it, its number may be that of something else by now: of
/// the library's own socket to the node, say, or of its memory. So only what the library has found there at first is written to, or what the
/// program has put there since that is a terminal, a pipe or a file with a name.
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

/// Writes all of it, however long that takes, and without the lock that Rust's own writers to the standard error share.
pub(super) fn to_stderr(line: &[u8]) {
    let mut rest = line;
    while !rest.is_empty() && is_writable() {
        match rustix::io::write(stderr(), rest) {
            Ok(0) => return,
            Ok(count) => rest = &rest[count..],
            Err(Errno::INTR) => {}
            // Somebody made it non-blocking.
            Err(Errno::AGAIN) => _ = poll(&mut [PollFd::new(&stderr(), PollFlags::OUT)], None),
            // There is none.
            Err(_) => return,
        }
    }
}

/// Whether the standard error takes anything, now or soon.
pub(super) fn is_taken() -> bool {
    poll(&mut [PollFd::new(&stderr(), PollFlags::OUT)], Some(&PATIENCE)) != Ok(0)
}

/// Runs `start` while the calling thread takes no signals. A thread that it makes never does.
pub(crate) fn without_signals<R>(start: impl FnOnce() -> R) -> R {
    let mut all = MaybeUninit::uninit();
    let mut before = MaybeUninit::uninit();
    // SAFETY: it writes the whole set. It does not fail.
    unsafe { libc::sigfillset(all.as_mut_ptr()) };
    // SAFETY: the first set was written above; the second has room for what was there before.
    let blocked = unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, all.as_ptr(), before.as_mut_ptr()) };
    let started = start();
    if blocked == 0 {
        // SAFETY: the call above has written this set.
        unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, before.as_ptr(), std::ptr::null_mut()) };
    }
    started
}

/// Puts the calling thread under the ordinary schedule: who says something first may have a real-time priority.
fn make_ordinary() {
    #[cfg(target_os = "linux")]
    {
        let none = libc::sched_param { sched_priority: 0 };
        // SAFETY: it reads the struct. 0 is the calling thread, which goes on as it is if that is refused.
        unsafe { libc::sched_setscheduler(0, libc::SCHED_OTHER, &raw const none) };
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    /// Time for what has to happen anyway.
    const WATCHDOG: Duration = Duration::from_secs(60);

    #[test]
    fn who_says_something_does_not_wait_for_one_who_takes_nothing_and_what_is_lost_is_counted() {
        // Given: something that takes nothing.
        let (release, released) = sync_channel::<()>(0);
        let (begins, begun) = sync_channel(1);
        let taken = Arc::new(Mutex::new(Vec::new()));
        let its_taken = taken.clone();
        let lines = Lines::begin(move |line| {
            let _ = begins.try_send(());
            // Until the sender is dropped.
            let _ = released.recv_timeout(WATCHDOG);
            its_taken.lock().expect("nobody panics").push(String::from_utf8_lossy(line).into_owned());
        });
        let lines = lines.expect("a thread");
        lines.enter(b"0\n");
        begun.recv_timeout(WATCHDOG).expect("the thread takes it");

        // When: more is said than has room.
        (1..=QUEUE_MAX + 3).for_each(|number| lines.enter(format!("{number}\n").as_bytes()));

        // Then:
        drop(release);
        lines.flush(WATCHDOG);
        let taken = taken.lock().expect("nobody panics");
        assert_eq!(taken.len(), QUEUE_MAX + 2, "{taken:?}");
        assert!(taken[1].contains("3 lines are missing"), "{taken:?}");
        assert_eq!(taken.last(), Some(&format!("{QUEUE_MAX}\n")));
    }

    #[test]
    fn a_line_has_a_greatest_length() {
        let (say, taken) = sync_channel(1);
        let lines = Lines::begin(move |line| _ = say.send(line.to_vec())).expect("a thread");
        lines.enter(&[b'x'; 2 * LINE_BYTES_MAX]);
        let line = taken.recv_timeout(WATCHDOG).expect("a line");
        assert_eq!((line.len(), line.last()), (LINE_BYTES_MAX, Some(&b'\n')));
    }
}
