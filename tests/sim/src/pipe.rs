//! One direction of a connection.

use std::collections::VecDeque;

use sinew_runtime::time::Time;

use crate::Chance;

/// One direction of a connection: reliable and in order, until it is cut.
#[derive(Clone, Debug)]
pub struct Pipe<M> {
    in_flight: VecDeque<(Time, M)>,
}

impl<M> Default for Pipe<M> {
    fn default() -> Self {
        Self { in_flight: VecDeque::new() }
    }
}

impl<M> Pipe<M> {
    /// Sends a message that arrives at `at`, or with the message before it. Returns the time of its arrival.
    pub fn send(&mut self, at: Time, message: M) -> Time {
        let at = self.in_flight.back().map_or(at, |(last, _)| at.max(*last));
        self.in_flight.push_back((at, message));
        at
    }

    /// Returns the next message that has arrived.
    pub fn receive(&mut self, now: Time) -> Option<M> {
        self.in_flight.pop_front_if(|(at, _)| *at <= now).map(|(_, message)| message)
    }

    /// Cuts the connection. A random number of the first messages still arrives; returns the others, which
    /// are lost.
    pub fn cut(&mut self, chance: &mut Chance) -> Vec<M> {
        let arrive = chance.index(self.in_flight.len() + 1);
        self.in_flight.drain(arrive..).map(|(_, message)| message).collect()
    }

    /// Returns the number of messages in flight.
    #[must_use]
    pub fn len(&self) -> usize {
        self.in_flight.len()
    }

    /// Returns whether no message is in flight.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.in_flight.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn at(nanos: u64) -> Time {
        Time::from_nanos(nanos)
    }

    #[test]
    fn messages_never_overtake_each_other() {
        let mut pipe = Pipe::default();
        assert_eq!(pipe.send(at(9), 'a'), at(9));
        assert_eq!(pipe.send(at(5), 'b'), at(9));
        assert_eq!((pipe.receive(at(8)), pipe.len()), (None, 2));
        assert_eq!(
            [pipe.receive(at(9)), pipe.receive(at(9)), pipe.receive(at(9))],
            [Some('a'), Some('b'), None]
        );
    }

    #[test]
    fn cut_loses_the_last_messages() {
        let mut kept = std::collections::BTreeSet::new();
        for seed in 0..50 {
            let mut pipe = Pipe::default();
            (0..3).for_each(|number| _ = pipe.send(at(1), number));
            let lost = pipe.cut(&mut Chance::new(seed));
            let arrived: Vec<_> = std::iter::from_fn(|| pipe.receive(at(1))).collect();
            assert_eq!(arrived.iter().chain(&lost).copied().collect::<Vec<_>>(), [0, 1, 2]);
            kept.insert(arrived.len());
        }
        assert_eq!(kept.len(), 4, "each number was kept at times");
    }
}
