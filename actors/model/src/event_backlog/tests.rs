use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;

/// An event about subject `subject`, in its incarnation `incarnation`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Event {
    subject: u8,
    incarnation: u8,
    kind: Kind,
    /// The position of the event in the sequence of all.
    at: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Begins,
    State(u8),
    Ends,
    Note,
}

#[derive(Clone, Copy, Debug)]
struct Rules<const KEEPS: bool>;

impl<const KEEPS: bool> CoalescingRules for Rules<KEEPS> {
    type Event = Event;
    type Subject = u8;
    type Incarnation = u8;

    const KEEPS_UNKNOWN_ENDS: bool = KEEPS;

    fn subject(&self, event: &Event) -> u8 {
        event.subject
    }

    fn role(&self, event: &Event) -> Role<u8> {
        match event.kind {
            Kind::Begins => Role::Begins(event.incarnation),
            Kind::State(_) => Role::Changes,
            Kind::Ends => Role::Ends(event.incarnation),
            Kind::Note => Role::Standalone,
        }
    }

    fn supersedes(&self, later: &Event, former: &Event) -> bool {
        match later.kind {
            Kind::Begins | Kind::Ends => matches!(former.kind, Kind::Begins | Kind::State(_)),
            Kind::State(_) => matches!(former.kind, Kind::State(_)),
            Kind::Note => former.kind == Kind::Note,
        }
    }

    fn is_minor(&self, event: &Event) -> bool {
        event.kind == Kind::Note
    }
}

/// The incarnation and the state of each subject that is present.
type Present = BTreeMap<u8, (u8, u8)>;

fn handle(present: &mut Present, event: &Event) {
    match event.kind {
        Kind::Begins => _ = present.insert(event.subject, (event.incarnation, 0)),
        Kind::State(state) => {
            present.entry(event.subject).and_modify(|present| present.1 = state);
        }
        Kind::Ends if present.get(&event.subject).is_some_and(|is| is.0 == event.incarnation) => {
            present.remove(&event.subject);
        }
        Kind::Ends | Kind::Note => {}
    }
}

/// Subjects that are present at one time, at most.
const PRESENT_MAX: usize = 3;
/// All that must not be dropped: the end of each known subject, and the begin and the state of each present one.
const CAPACITY: usize = 3 * PRESENT_MAX;

/// Pushes a possible event for each step, and offers that many events. Returns the truth, all that happened, and
/// all that was taken.
fn run<const KEEPS: bool>(
    backlog: &mut EventBacklog<Rules<KEEPS>>,
    steps: &[(u8, u8, usize)],
) -> (Present, Vec<Event>, Vec<Event>) {
    let (mut truth, mut happened, mut taken) = (Present::new(), Vec::new(), Vec::new());
    let mut incarnations = [0; 8];
    for (at, (subject, choice, room)) in steps.iter().copied().enumerate() {
        let incarnation = &mut incarnations[usize::from(subject)];
        let kind = match (truth.contains_key(&subject), choice) {
            (_, 0) => Kind::Note,
            (true, 1..=4) => Kind::State(choice),
            (true, _) => Kind::Ends,
            (false, _) if truth.len() == PRESENT_MAX => Kind::Note,
            (false, 1) => Kind::Begins,
            (false, _) => {
                *incarnation += 1;
                Kind::Begins
            }
        };
        let event = Event { subject, incarnation: *incarnation, kind, at };
        handle(&mut truth, &event);
        happened.push(event);
        backlog.push(event);
        assert!(backlog.len() <= CAPACITY);
        let mut room = room;
        let has_all = backlog.offer(|event| {
            let is_taken = room > 0;
            if is_taken {
                taken.push(*event);
                room -= 1;
            }
            is_taken
        });
        assert_eq!(has_all, backlog.is_empty());
    }
    assert!(backlog.offer(|event| {
        taken.push(*event);
        true
    }));
    (truth, happened, taken)
}

/// The events in the order in which their positions were taken: an end that was replaced by a later one of its
/// incarnation has the position of the earlier.
fn is_in_order(happened: &[Event], taken: &[Event]) -> bool {
    let unnumbered = |event: &Event| (event.subject, event.incarnation, event.kind);
    let mut later = happened.iter();
    taken.iter().all(|taken| later.any(|happened| unnumbered(happened) == unnumbered(taken)))
}

fn check<const KEEPS: bool>(steps: &[(u8, u8, usize)]) {
    let mut backlog = EventBacklog::new(Rules::<KEEPS>, CAPACITY);
    let (truth, happened, taken) = run(&mut backlog, steps);
    let mut known = Present::new();
    taken.iter().for_each(|event| handle(&mut known, event));
    assert_eq!(known, truth);
    assert!(is_in_order(&happened, &taken), "{taken:?}");
    // Nothing is kept of events that were taken, except the knowledge of the reader.
    assert!(backlog.numbers.is_empty());
    assert_eq!(backlog.known, truth.iter().map(|(subject, is)| (*subject, is.0)).collect());
}

proptest! {
    #[test]
    fn reader_ends_with_the_true_state_within_bounds(
        steps in prop::collection::vec((0_u8..8, 0_u8..8, 0_usize..4), 0..128)
    ) {
        check::<false>(&steps);
        check::<true>(&steps);
    }

    #[test]
    fn stalled_reader_ends_with_the_true_state(
        steps in prop::collection::vec((0_u8..8, 0_u8..8, Just(0)), 0..128)
    ) {
        check::<false>(&steps);
        check::<true>(&steps);
    }
}

#[test]
fn end_of_unknown_incarnation_is_kept_only_if_needed() {
    let event = |kind, at| Event { subject: 1, incarnation: 1, kind, at };
    let events = [event(Kind::Begins, 0), event(Kind::State(1), 1), event(Kind::Ends, 2)];
    let (mut keeps, mut drops) =
        (EventBacklog::new(Rules::<true>, CAPACITY), EventBacklog::new(Rules::<false>, CAPACITY));
    for event in events {
        keeps.push(event);
        drops.push(event);
    }
    assert_eq!((keeps.len(), drops.len()), (1, 0));
}

#[test]
fn notes_are_dropped_before_the_oldest_event() {
    let event = |subject, kind| Event { subject, incarnation: 1, kind, at: 0 };
    let mut backlog = EventBacklog::new(Rules::<true>, 2);
    for event in [event(1, Kind::Begins), event(2, Kind::Note), event(3, Kind::Begins)] {
        backlog.push(event);
    }
    assert_eq!(backlog.events_mut().map(|event| event.subject).collect::<Vec<_>>(), [1, 3]);
    backlog.push(event(4, Kind::Begins));
    assert_eq!(backlog.events_mut().map(|event| event.subject).collect::<Vec<_>>(), [3, 4]);
}
