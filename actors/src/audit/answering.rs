//! The thread `audit`, which is there as long as other nodes wait for an answer: to say where all messages are of a node with 1,000
//! applications takes longer than the sync manager may stand still, who says that a requirement is lost or that a barrier is open.
//!
//! It is nicer than the threads that it takes locks from, and stays so while it has one: to be less nice again needs a privilege. So it holds each
//! for a copy of bounded length only: the counters of one place, or the pointers of a list, and never for a walk through messages, but the few of layers'
//! events that wait in one mailbox. Its answer of 256 KiB at most is put into the queue of who has asked, and written by whoever writes what waits there: so
//! nobody who has an outcome to settle in that outlet, or on a link of one connection Control to send, waits for a nice thread that writes.

use std::{collections::VecDeque, sync::Arc, thread};

use sinew_runtime::{
    remedy::{Wanted, remedy},
    tid::NodeAddress,
    time::Time,
};

use super::asking::answer;
use crate::{
    nicer::give_way,
    stores::{Stores, lock},
};

/// Questions that wait at most. A further one is not answered, and counted.
const WAITING_MAX: usize = 64;

/// Questions of other nodes that wait for their answers.
#[derive(Default)]
pub(super) struct Waiting {
    /// Who asks, and the number of the question.
    questions: VecDeque<(NodeAddress, u64)>,
    /// Whether there is a thread that takes them.
    is_taken: bool,
}

/// Has this question answered, some time.
///
/// # Errors
/// It is not answered: too many wait, or the system gives no thread. In words.
pub(super) fn have_answered(stores: &Arc<Stores>, to: NodeAddress, number: u64) -> Result<(), String> {
    {
        let mut waiting = lock(&stores.questions.waiting);
        if waiting.questions.len() >= WAITING_MAX {
            return Err(format!("from {to}, a question for an audit behind {WAITING_MAX} that wait"));
        }
        waiting.questions.push_back((to, number));
        if std::mem::replace(&mut waiting.is_taken, true) {
            return Ok(());
        }
    }
    let taker = Taker { stores: stores.clone(), takes: true };
    let begun = thread::Builder::new().name("audit".to_owned()).spawn(move || taker.run());
    begun.map(drop).map_err(|cause| {
        format!("from {to}, and no thread answers it: {cause}; {}", remedy(Wanted::Thread, &cause))
    })
}

/// Who takes the questions. Whatever ends it, the next question begins another one, and what it left waits for that.
struct Taker {
    stores: Arc<Stores>,
    takes: bool,
}

impl Taker {
    fn run(mut self) {
        give_way();
        while let Some((to, number)) = self.next() {
            if let Err(fault) = answer(&self.stores, to, number) {
                self.stores.refusals.count(Time::now(), "audit", &fault);
            }
        }
    }

    /// The next question. With none left, it takes no further one.
    fn next(&mut self) -> Option<(NodeAddress, u64)> {
        let mut waiting = lock(&self.stores.questions.waiting);
        let next = waiting.questions.pop_front();
        self.takes = next.is_some();
        waiting.is_taken = self.takes;
        next
    }
}

impl Drop for Taker {
    fn drop(&mut self) {
        // Where it takes none any more, another one may.
        if self.takes {
            lock(&self.stores.questions.waiting).is_taken = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use bytes::Bytes;
    use sinew_runtime::{
        mailbox::Mailbox,
        router::Outlet,
        tid::{AppAddress, Incarnation, Tid},
        wire::{Class, Header, Kind, Message},
    };

    use super::*;
    use crate::{
        audit::{reading, words},
        config::NodeConfig,
    };

    const OTHER: NodeAddress = NodeAddress::new(2);

    fn stores() -> Arc<Stores> {
        Stores::for_test(NodeConfig::new("test"), Incarnation(1))
    }

    /// Waits until nobody takes questions any more.
    fn wait(stores: &Stores) {
        let began = Instant::now();
        while lock(&stores.questions.waiting).is_taken {
            assert!(began.elapsed() < Duration::from_secs(60), "the thread `audit` does not end");
            thread::yield_now();
        }
    }

    fn counted(stores: &Stores) -> u64 {
        stores
            .refusals
            .by_cause()
            .into_iter()
            .find(|(cause, _)| *cause == "audit")
            .map_or(0, |(_, count)| count)
    }

    #[test]
    fn each_question_is_taken_and_the_thread_goes_when_none_is_left() {
        let stores = stores();
        for round in 1..=3 {
            for number in 0..10 {
                have_answered(&stores, OTHER, number).expect("there is room, and a thread");
            }
            wait(&stores);
            // Nobody is linked, so that none of the answers goes anywhere.
            assert_eq!(counted(&stores), 10 * round);
        }
    }

    #[test]
    fn questions_that_wait_are_bounded_and_outlive_who_took_them() {
        let stores = stores();
        lock(&stores.questions.waiting).is_taken = true;
        let taker = Taker { stores: stores.clone(), takes: true };
        for number in 0..WAITING_MAX as u64 {
            have_answered(&stores, OTHER, number).expect("there is room");
        }
        assert!(have_answered(&stores, OTHER, 99).is_err());
        // It ends before its time, as at a panic.
        drop(taker);
        lock(&stores.questions.waiting).questions.pop_back();
        have_answered(&stores, OTHER, 100).expect("there is room for one, and a thread");
        wait(&stores);
        assert_eq!(counted(&stores), WAITING_MAX as u64);
    }

    #[test]
    #[ignore = "it prints what an audit costs, and claims nothing"]
    fn what_an_audit_costs() {
        for apps in [10, 100, 1_000] {
            let stores = stores();
            for app in 0..apps {
                let (mailbox, tid) = (Mailbox::new(8), Tid::new(stores.node, AppAddress::new(0x1000 + app)));
                stores.book.add_mailbox(tid.app, &format!("left_leg.knee.controller_{app}"), &mailbox);
                for class in Class::ALL {
                    let mut header = Header::new(Kind::named("audit.cost"), tid, tid);
                    header.class = class;
                    mailbox.submit(Message::new(header, Bytes::new())).expect("there is room");
                }
            }
            let (mut read, mut written, mut bytes) = (Duration::MAX, Duration::MAX, 0);
            for _ in 0..20 {
                let begin = Instant::now();
                let audit = reading::read(&stores);
                read = read.min(begin.elapsed());
                let begin = Instant::now();
                bytes = words::write(&audit, usize::MAX).expect("it has room").len();
                written = written.min(begin.elapsed());
            }
            println!("{apps} applications: read in {read:?}, written in {written:?} ({bytes} bytes)");
        }
    }
}
