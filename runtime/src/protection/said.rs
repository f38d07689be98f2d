//! What is to be said of outputs: when they are safe, without a lock in hand, and not by the thread that makes them so. The queue to the log
//! has a lock, which ordinary threads hold, and so has memory that is given back: that thread leaves what it has to say, and what it has no use for,
//! to one of those.

use std::{
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Mutex, OnceLock, PoisonError, TryLockError,
        atomic::{AtomicU64, Ordering},
    },
    thread::{self, Thread},
};

use super::{Cause, keeper::Rubbish};
use crate::{supervision::make_like_any_other, tid::Tid};

/// What is left to be said at most. What comes then is counted.
const UNSAID_MAX: usize = 256;

/// What is to be said of one output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Said {
    pub(super) source: Tid,
    /// The name of the type that moves it.
    pub(super) name: &'static str,
    pub(super) cause: Cause,
    pub(super) what: What,
}

/// What has become of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum What {
    IsSafe,
    HasFailed,
}

impl Said {
    /// Waits for whoever has the log's queue in hand.
    pub(super) fn log(self) {
        let Self { source, name, cause, what } = self;
        match what {
            What::IsSafe => {
                crate::log::warn!(%source, of = name, %cause, "a guard is shut; its output, if it has one, is safe");
            }
            What::HasFailed => {
                crate::log::error!(%source, of = name, %cause, "what makes an output safe has panicked, or says that it has failed; it is tried again each millisecond");
            }
        }
    }
}

/// What the thread that makes outputs safe has to say, and has not handed over.
pub(super) struct Unsaid {
    own: Vec<Said>,
    /// How many more there were.
    lost: u64,
}

struct Left {
    said: Vec<Said>,
    /// To be dropped.
    rubbish: Vec<Rubbish>,
}

/// What is handed over.
static LEFT: Mutex<Left> = Mutex::new(Left { said: Vec::new(), rubbish: Vec::new() });
static LOST: AtomicU64 = AtomicU64::new(0);
static SPEAKER: OnceLock<Thread> = OnceLock::new();

impl Default for Unsaid {
    fn default() -> Self {
        Self { own: Vec::with_capacity(UNSAID_MAX), lost: 0 }
    }
}

impl Unsaid {
    pub(super) fn note(&mut self, said: Option<Said>) {
        let Some(said) = said else { return };
        if self.own.len() < UNSAID_MAX {
            self.own.push(said);
        } else {
            self.lost += 1;
        }
    }

    /// Leaves it to the thread that says it, and drops the rubbish, as far as there is room for that. `false`: somebody has that one's list in hand
    /// just now, or there is more to be said than it takes.
    pub(super) fn hand_over(&mut self, rubbish: &mut Vec<Rubbish>) -> bool {
        if self.own.is_empty() && rubbish.is_empty() {
            return true;
        }
        let mut left = match LEFT.try_lock() {
            Ok(left) => left,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return false,
        };
        let room = UNSAID_MAX.saturating_sub(left.said.len()).min(self.own.len());
        left.said.extend(self.own.drain(..room));
        let room = UNSAID_MAX.saturating_sub(left.rubbish.len()).min(rubbish.len());
        left.rubbish.extend(rubbish.drain(..room));
        drop(left);
        LOST.fetch_add(std::mem::take(&mut self.lost), Ordering::Relaxed);
        if let Some(speaker) = SPEAKER.get() {
            speaker.unpark();
        }
        self.own.is_empty()
    }
}

/// Starts the thread that says it. Called by one at a time.
///
/// # Errors
/// There is none to be had.
pub(super) fn begin() -> io::Result<()> {
    if SPEAKER.get().is_some() {
        return Ok(());
    }
    let mut left = LEFT.lock().unwrap_or_else(PoisonError::into_inner);
    left.said.reserve(UNSAID_MAX);
    left.rubbish.reserve(UNSAID_MAX);
    drop(left);
    let speaker = thread::Builder::new().name("safe-output-log".to_owned()).spawn(speak)?;
    SPEAKER.get_or_init(|| speaker.thread().clone());
    Ok(())
}

fn speak() {
    make_like_any_other();
    let mut said = Vec::with_capacity(UNSAID_MAX);
    let mut rubbish = Vec::with_capacity(UNSAID_MAX);
    loop {
        {
            let mut left = LEFT.lock().unwrap_or_else(PoisonError::into_inner);
            said.append(&mut left.said);
            rubbish.append(&mut left.rubbish);
        }
        said.drain(..).for_each(Said::log);
        // What is dropped is the user's, and may panic.
        rubbish.drain(..).for_each(|rubbish| _ = catch_unwind(AssertUnwindSafe(|| drop(rubbish))));
        let lost = LOST.swap(0, Ordering::Relaxed);
        if lost > 0 {
            crate::log::warn!(lost, "more was to be said of outputs that were made safe than was kept");
        }
        thread::park();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::{AppAddress, NodeAddress};

    #[test]
    fn what_is_to_be_said_waits_while_somebody_has_the_list_in_hand() {
        let source = Tid::new(NodeAddress::new(7), AppAddress::new(1));
        let said = Said { source, name: "test.said", cause: Cause::Tripped, what: What::IsSafe };
        let mut unsaid = Unsaid::default();
        (0..UNSAID_MAX + 2).for_each(|_| unsaid.note(Some(said)));
        let in_hand = LEFT.lock().expect("nobody panics with it");
        let mut rubbish = Vec::new();
        assert!(!unsaid.hand_over(&mut rubbish), "it does not wait");
        assert_eq!((unsaid.own.len(), unsaid.lost), (UNSAID_MAX, 2));
        drop(in_hand);
        begin().expect("there is a thread");
        while !unsaid.hand_over(&mut rubbish) {
            thread::yield_now();
        }
        assert_eq!(unsaid.lost, 0);
    }
}
