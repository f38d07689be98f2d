//! Who is told of nodes, and what each of them has not been told yet.
//!
//! An application that takes an event hears of the next one, in order. One whose mailbox is full is offered the same again in 10 ms;
//! until it has caught up, what happens to a node takes the place of what it was not told of that node before.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::{
    tid::{AppAddress, NodeAddress},
    time::Time,
};

use super::Core;
use crate::ndl::NodeEvent;

/// Time until an application that did not take an event is offered it again.
const RETRY: Duration = Duration::from_millis(10);
/// Events that are kept for one application at most, for each node that may be a member: that it is there, and three of its parts.
const PER_NODE_MAX: usize = 4;
/// As many more: nodes that are gone.
const MORE_MAX: usize = 64;

/// What an event is about: a node, or a layer or an application of it.
type Subject = (NodeAddress, Option<AppAddress>);

fn subject(event: &NodeEvent) -> Subject {
    match event {
        NodeEvent::NodeFound { node, .. }
        | NodeEvent::NodeLost { node, .. }
        | NodeEvent::NodeRestarted { node, .. } => (*node, None),
        NodeEvent::AppStalled { node, app, .. } | NodeEvent::AppResumed { node, app, .. } => {
            (*node, Some(app.app))
        }
    }
}

/// Applications that hear of changes.
#[derive(Debug)]
pub(super) struct Audience {
    queues: BTreeMap<AppAddress, Queue>,
    /// Those that have something to hear now.
    eager: BTreeSet<AppAddress>,
    /// When those that did not take an event are offered it again.
    retry: Option<Time>,
    queue_max: usize,
    /// Events that found no room and were not reported yet.
    left_out: u64,
}

/// What one of them has not been told yet, in order.
#[derive(Debug, Default)]
struct Queue {
    events: BTreeMap<u64, NodeEvent>,
    numbered: u64,
    /// It was offered this last.
    in_hand: Option<(u64, NodeEvent)>,
    /// It has not taken everything since it did not take something.
    is_behind: bool,
    /// Where the event about each subject is, as long as it is behind.
    latest: BTreeMap<Subject, u64>,
    /// It is offered nothing before the next retry.
    rests: bool,
}

impl Queue {
    /// Keeps `event`; of more than `most` one is left out.
    fn push(&mut self, event: NodeEvent, most: usize) -> Result<(), ()> {
        if self.events.is_empty() {
            // It took all that it was offered.
            self.is_behind = false;
            self.latest.clear();
        }
        let (number, subject) = (self.numbered, subject(&event));
        self.numbered += 1;
        if self.is_behind {
            self.replace(number, event);
        } else {
            self.events.insert(number, event);
        }
        if self.events.len() <= most {
            return Ok(());
        }
        let is_of_node = subject.1.is_none();
        self.leave_out(if is_of_node { self.newest_of_a_part().unwrap_or(number) } else { number });
        Err(())
    }

    /// That a node is there, or is not, goes before what is said of parts of others.
    fn newest_of_a_part(&self) -> Option<u64> {
        let mut parts = self.events.iter().filter(|(_, event)| subject(event).1.is_some());
        parts.next_back().map(|(number, _)| *number)
    }

    fn leave_out(&mut self, number: u64) {
        self.events.remove(&number);
        self.latest.retain(|_, latest| *latest != number);
    }

    /// Puts `event` in the place of what it makes out of date: one about a node that of its parts, too.
    fn replace(&mut self, number: u64, event: NodeEvent) {
        let subject = subject(&event);
        let last = match subject {
            (node, None) => (node, Some(AppAddress::new(u32::MAX))),
            (_, Some(_)) => subject,
        };
        let former: Vec<Subject> = self.latest.range(subject..=last).map(|(subject, _)| *subject).collect();
        for subject in former {
            if let Some(number) = self.latest.remove(&subject) {
                self.events.remove(&number);
            }
        }
        self.latest.insert(subject, number);
        self.events.insert(number, event);
    }

    fn next(&mut self) -> Option<NodeEvent> {
        let (number, event) = self.events.pop_first()?;
        self.latest.remove(&subject(&event));
        self.in_hand = Some((number, event.clone()));
        Some(event)
    }

    /// What it was offered last stands before all others again, unless it is out of date by now.
    fn not_taken(&mut self) {
        self.rests = true;
        let Some((number, event)) = self.in_hand.take() else { return };
        if !self.is_behind {
            self.is_behind = true;
            self.events.insert(number, event);
            for (number, event) in std::mem::take(&mut self.events) {
                self.replace(number, event);
            }
            return;
        }
        let subject = subject(&event);
        if !self.latest.contains_key(&subject) && !self.latest.contains_key(&(subject.0, None)) {
            self.latest.insert(subject, number);
            self.events.insert(number, event);
        }
    }
}

impl Audience {
    /// Nobody, where there are `nodes_max` members at most.
    pub(super) const fn new(nodes_max: usize) -> Self {
        let queue_max = nodes_max * PER_NODE_MAX + MORE_MAX;
        Self { queues: BTreeMap::new(), eager: BTreeSet::new(), retry: None, queue_max, left_out: 0 }
    }

    /// It has heard of nothing yet.
    pub(super) fn add(&mut self, app: AppAddress) {
        self.queues.insert(app, Queue::default());
    }

    /// It is there no more: nothing is kept for it.
    pub(super) fn remove(&mut self, app: AppAddress) {
        self.queues.remove(&app);
        self.eager.remove(&app);
    }

    pub(super) fn tell(&mut self, app: AppAddress, event: NodeEvent) {
        let Some(queue) = self.queues.get_mut(&app) else { return };
        self.left_out += u64::from(queue.push(event, self.queue_max).is_err());
        if !queue.rests {
            self.eager.insert(app);
        }
    }

    pub(super) fn tell_all(&mut self, event: &NodeEvent) {
        let apps: Vec<AppAddress> = self.queues.keys().copied().collect();
        for app in apps {
            self.tell(app, event.clone());
        }
    }

    /// The next event, and who is to be told.
    pub(super) fn next(&mut self) -> Option<(AppAddress, NodeEvent)> {
        while let Some(app) = self.eager.first().copied() {
            if let Some(event) = self.queues.get_mut(&app).and_then(Queue::next) {
                return Some((app, event));
            }
            self.eager.remove(&app);
        }
        None
    }

    /// It had no room for what it was offered last.
    pub(super) fn not_taken(&mut self, now: Time, app: AppAddress) {
        let Some(queue) = self.queues.get_mut(&app) else { return };
        queue.not_taken();
        self.eager.remove(&app);
        self.retry.get_or_insert(now + RETRY);
    }

    pub(super) fn offer_again(&mut self, now: Time) {
        if self.retry.is_none_or(|retry| now < retry) {
            return;
        }
        self.retry = None;
        for (app, queue) in self.queues.iter_mut().filter(|(_, queue)| queue.rests) {
            queue.rests = false;
            self.eager.insert(*app);
        }
    }

    pub(super) const fn next_wake(&self) -> Option<Time> {
        self.retry
    }

    /// How many events found no room since this was asked last.
    pub(super) fn take_left_out(&mut self) -> u64 {
        std::mem::take(&mut self.left_out)
    }
}

impl Core {
    /// Tells every application that subscribed.
    pub(super) fn publish(&mut self, event: &NodeEvent) {
        self.audience.tell_all(event);
    }

    pub(super) fn offer_again(&mut self, now: Time) {
        self.audience.offer_again(now);
        let left_out = self.audience.take_left_out();
        if left_out > 0 {
            let what =
                format_args!("{left_out} events: applications take nothing, and too many wait for them");
            self.refusals.count(now, "more events than are kept for an application", &what);
        }
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{Incarnation, Tid};

    use super::*;
    use crate::ndl::{LossReason, Trouble};

    const APP: AppAddress = AppAddress::new(0x1000);

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_millis(millis)
    }

    fn found(node: u32) -> NodeEvent {
        NodeEvent::NodeFound {
            node: NodeAddress::new(node),
            name: String::new(),
            incarnation: Incarnation(1),
        }
    }

    fn lost(node: u32) -> NodeEvent {
        let (node, why) = (NodeAddress::new(node), LossReason::Hung);
        NodeEvent::NodeLost {
            node,
            name: String::new(),
            incarnation: Incarnation(1),
            why,
            silent_us: 1,
            bound_us: 2,
        }
    }

    fn stalled(node: u32, app: u32) -> NodeEvent {
        let node = NodeAddress::new(node);
        NodeEvent::AppStalled {
            node,
            name: String::new(),
            app: Tid::new(node, AppAddress::new(app)),
            app_name: String::new(),
            trouble: Trouble::Down,
            since_us: 1,
        }
    }

    /// One that was told `first`, and has not taken it.
    fn behind(first: NodeEvent) -> Audience {
        let mut audience = Audience::new(1);
        audience.add(APP);
        audience.tell(APP, first.clone());
        assert_eq!(audience.next(), Some((APP, first)));
        audience.not_taken(at(0), APP);
        audience
    }

    fn takes_all(audience: &mut Audience) -> Vec<NodeEvent> {
        std::iter::from_fn(|| audience.next()).map(|(_, event)| event).collect()
    }

    #[test]
    fn who_takes_everything_hears_every_change_in_order() {
        let mut audience = Audience::new(1);
        audience.add(APP);
        let events = [found(1), lost(1), found(1), stalled(1, 7), lost(1)];
        events.iter().for_each(|event| audience.tell_all(event));
        assert_eq!(takes_all(&mut audience), events);
        assert_eq!(audience.next_wake(), None);
    }

    #[test]
    fn what_was_not_taken_is_offered_again_before_what_came_later() {
        let mut audience = behind(lost(1));
        audience.tell_all(&found(2));
        assert_eq!((audience.next(), audience.next_wake()), (None, Some(at(10))));
        audience.offer_again(at(9));
        assert_eq!(audience.next(), None);
        audience.offer_again(at(10));
        assert_eq!(audience.next(), Some((APP, lost(1))));
        audience.not_taken(at(10), APP);
        assert_eq!((audience.next(), audience.next_wake()), (None, Some(at(20))));
        audience.offer_again(at(20));
        assert_eq!(takes_all(&mut audience), [lost(1), found(2)]);
        // It has caught up: each change is told.
        [lost(2), found(2)].iter().for_each(|event| audience.tell_all(event));
        assert_eq!(takes_all(&mut audience), [lost(2), found(2)]);
    }

    #[test]
    fn who_is_behind_hears_of_each_node_what_is_so_last() {
        let mut audience = behind(lost(1));
        for event in [stalled(2, 7), found(1), stalled(1, 7), stalled(1, 8), lost(2), stalled(1, 7)] {
            audience.tell_all(&event);
        }
        audience.offer_again(at(10));
        assert_eq!(takes_all(&mut audience), [found(1), stalled(1, 8), lost(2), stalled(1, 7)]);
    }

    #[test]
    fn what_is_told_in_one_breath_with_what_is_not_taken_makes_that_out_of_date() {
        let mut audience = Audience::new(1);
        audience.add(APP);
        [lost(1), found(1), lost(2)].iter().for_each(|event| audience.tell_all(event));
        assert_eq!(audience.next(), Some((APP, lost(1))));
        audience.not_taken(at(0), APP);
        audience.offer_again(at(10));
        assert_eq!(takes_all(&mut audience), [found(1), lost(2)]);
    }

    #[test]
    fn that_a_node_is_lost_is_kept_however_much_is_said_of_parts_of_others() {
        for is_behind in [false, true] {
            // given
            let mut audience = Audience::new(1);
            audience.add(APP);
            if is_behind {
                audience = behind(lost(3));
            }
            (0..100).for_each(|app| audience.tell_all(&stalled(2, app)));
            // when
            audience.tell_all(&lost(1));
            // then
            audience.offer_again(at(10));
            let told = takes_all(&mut audience);
            assert_eq!((told.len(), told.last()), (PER_NODE_MAX + MORE_MAX, Some(&lost(1))));
        }
    }

    #[test]
    fn no_more_is_kept_than_there_is_room_for_and_who_is_gone_hears_nothing() {
        let mut audience = behind(lost(1));
        let most = PER_NODE_MAX + MORE_MAX;
        (2..100).for_each(|node| audience.tell_all(&lost(node)));
        // In the place of one that is kept there is room.
        audience.tell_all(&found(2));
        audience.offer_again(at(10));
        assert_eq!(takes_all(&mut audience).len(), most);
        assert_eq!(audience.take_left_out(), 99 - most as u64);
        let mut audience = behind(lost(1));
        audience.remove(APP);
        audience.offer_again(at(10));
        assert_eq!(audience.next(), None);
    }
}
