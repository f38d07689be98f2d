//! One check of all incarnations: its time, and the accounts of threads that it has read.

use std::time::Duration;

use super::{processor, rest::Pace};
use crate::{supervision::threads::ThreadSlot, time::Time};

/// One check of all incarnations.
pub(super) struct Round {
    pub(super) now: Time,
    pub(super) late: Duration,
    pub(super) period: Duration,
    pub(super) pace: Pace,
    /// The threads of actors at rest that were read in this round.
    threads: Vec<ThreadAtRest>,
}

/// A thread of actors at rest, read once in a round for all of them.
pub(super) struct ThreadAtRest {
    tid: i32,
    /// The sum of the turn numbers of its actors.
    pub(super) turns: u64,
    /// How long it has waited for a CPU, in nanoseconds, once that is read.
    waited: Option<Option<u64>>,
}

impl Round {
    pub(super) const fn new(now: Time, late: Duration, period: Duration, pace: Pace) -> Self {
        Self { now, late, period, pace, threads: Vec::new() }
    }

    /// Returns the thread with this ID, which `slot` describes.
    pub(super) fn thread(&mut self, tid: i32, slot: &ThreadSlot) -> &mut ThreadAtRest {
        let known = self.threads.iter().position(|thread| thread.tid == tid);
        let at = known.unwrap_or_else(|| {
            self.threads.push(ThreadAtRest { tid, turns: slot.turn_sum(), waited: None });
            self.threads.len() - 1
        });
        &mut self.threads[at]
    }
}

impl ThreadAtRest {
    /// Returns how long the thread has waited for a CPU, in nanoseconds, if that is known.
    pub(super) fn waited(&mut self) -> Option<u64> {
        let tid = self.tid;
        *self.waited.get_or_insert_with(|| processor::waited(tid))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::supervision::{
        Place,
        actor_handle::ActorHandle,
        liveness::{Activity, Liveness},
    };

    fn has_turn(actor: &ActorHandle) {
        Liveness::turn(&mut Some(actor.liveness().clone()), Activity::Timer, || {});
    }

    #[test]
    fn turns_of_each_thread_are_read_once_per_round() {
        let slot = ThreadSlot::of_this_thread(&Place::own_thread());
        let actors = ["one", "other"].map(|name| {
            let liveness = Liveness::new(name);
            let handle =
                ActorHandle::new(liveness, Some(slot.clone()), None, Box::new(|event| panic!("{event:?}")));
            slot.add(&handle);
            handle
        });
        let turns = |round: &mut Round| round.thread(7, &slot).turns;
        let next = || Round::new(Time::ZERO, Duration::ZERO, Duration::ZERO, Pace::Resting);
        let (mut round, [one, other]) = (next(), &actors);
        has_turn(one);
        assert_eq!(turns(&mut round), 2);
        has_turn(other);
        assert_eq!([turns(&mut round), turns(&mut next())], [2, 4], "the next round reads them again");
        other.liveness().set_ended();
        assert_eq!(turns(&mut next()), 2, "one has ended");
    }
}
