//! Time that passes while processes run, or while all of them stand still.

use super::*;

impl World {
    /// Lets time pass. Each process runs when its timer is due, and at the end.
    pub(super) fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        let next = |world: &Self| {
            let wakes = world.living().filter_map(|process| Some((world.next_wake(process)?, process)));
            wakes.min().filter(|(wake, _)| *wake <= end)
        };
        while let Some((wake, process)) = next(self) {
            self.now = wake.max(self.now);
            self.feed(process, Input::TimePassed);
            let next = self.next_wake(process);
            assert!(next.is_none_or(|next| next > self.now), "process {process} runs again and again");
        }
        self.now = end;
        self.wake_all();
    }

    /// Lets time pass in which no process runs.
    pub(super) fn stand_still(&mut self, time: Duration) {
        // No grace period of an earlier stall is left.
        self.pass(self.rested.since(self.now));
        self.note(|| format!("all stand still for {time:?}"));
        let since = self.now;
        self.now = since + time;
        self.rested = self.now + waits::GRACE_PERIOD_MAX;
        self.judge.waits.stood_still(since, self.now);
        self.wake_all();
    }

    fn wake_all(&mut self) {
        for process in self.living().collect::<Vec<_>>() {
            self.feed(process, Input::TimePassed);
        }
    }
}
