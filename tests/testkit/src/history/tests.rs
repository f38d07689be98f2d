//! The checker accepts a valid history, and detects every injected violation.

use proptest::prelude::*;
use sinew::{Class, Outcome, message::Rejection};

use super::{
    verdict::Fault::{self, *},
    *,
};

const ONE: Party = Party { station: 1, incarnation: 1 };
const TWO: Party = Party { station: 2, incarnation: 1 };

fn sent(class: Class, first: u64, count: u64) -> (Party, Note) {
    (ONE, Note::Sent { to: 2, class, first, count, asked: false })
}

fn asked(first: u64, count: u64) -> (Party, Note) {
    (ONE, Note::Sent { to: 2, class: Class::Control, first, count, asked: true })
}

fn got(class: Class, first: u64, count: u64) -> (Party, Note) {
    (TWO, Note::Got { from: ONE, class, first, count })
}

fn ended(number: u64, outcome: Outcome) -> (Party, Note) {
    (ONE, Note::Ended { to: 2, class: Class::Control, number, outcome })
}

fn lost(upto: [u64; 3]) -> (Party, Note) {
    (ONE, Note::PeerLost { to: 2, upto })
}

fn history(notes: &[(Party, Note)]) -> History {
    let mut history = History::default();
    notes.iter().for_each(|(who, note)| history.note(*who, *note));
    history
}

/// The faults of a history, and their counts.
fn faults(notes: &[(Party, Note)]) -> Vec<(Fault, u64)> {
    let verdict = history(notes).verdict();
    assert_eq!(verdict.holds(), verdict.faults.is_empty(), "{verdict}");
    verdict.faults.into_iter().collect()
}

/// Two classes, some messages confirmed, no fault.
fn clean() -> Vec<(Party, Note)> {
    let outcomes = (1..=3).map(|number| ended(number, Outcome::Delivered));
    let notes = [sent(Class::Bulk, 1, 10), asked(1, 3), got(Class::Control, 1, 3), got(Class::Bulk, 1, 10)];
    notes.into_iter().chain(outcomes).collect()
}

#[test]
fn complete_history_is_perfect() {
    let verdict = history(&clean()).verdict();
    assert!(verdict.holds() && verdict.is_perfect(), "{verdict}");
    assert_eq!((verdict.sent, verdict.got, verdict.asked), (13, 13, 3));
}

#[test]
fn order_between_parties_does_not_matter() {
    let mut notes = clean();
    notes.sort_by_key(|(who, _)| std::cmp::Reverse(*who));
    assert!(history(&notes).verdict().is_perfect());
}

#[test]
fn lost_message_is_detected_anywhere() {
    let middle = [sent(Class::Bulk, 1, 10), got(Class::Bulk, 1, 3), got(Class::Bulk, 6, 5)];
    assert_eq!(faults(&middle), [(Lost, 2)]);
    assert_eq!(faults(&[sent(Class::Bulk, 1, 10), got(Class::Bulk, 1, 9)]), [(Lost, 1)]);
    assert_eq!(faults(&[sent(Class::Bulk, 1, 10)]), [(Lost, 10)]);
}

#[test]
fn duplicated_message_is_detected() {
    assert_eq!(
        faults(&[sent(Class::Bulk, 1, 4), got(Class::Bulk, 1, 4), got(Class::Bulk, 4, 1)]),
        [(Duplicated, 1)]
    );
    let mut in_another_incarnation = clean();
    let note = Note::Got { from: ONE, class: Class::Bulk, first: 2, count: 1 };
    in_another_incarnation.push((Party { incarnation: 2, ..TWO }, note));
    assert_eq!(faults(&in_another_incarnation), [(Duplicated, 1)]);
}

#[test]
fn reordered_message_is_detected() {
    let notes =
        [sent(Class::Bulk, 1, 3), got(Class::Bulk, 1, 1), got(Class::Bulk, 3, 1), got(Class::Bulk, 2, 1)];
    assert_eq!(faults(&notes), [(Reordered, 1)]);
}

#[test]
fn message_of_former_incarnation_after_later_is_detected() {
    let later = Party { incarnation: 2, ..ONE };
    let notes = [
        sent(Class::Bulk, 1, 1),
        (later, Note::Sent { to: 2, class: Class::Bulk, first: 1, count: 1, asked: false }),
        (TWO, Note::Got { from: later, class: Class::Bulk, first: 1, count: 1 }),
        got(Class::Bulk, 1, 1),
    ];
    assert_eq!(faults(&notes), [(Reordered, 1)]);
}

#[test]
fn invented_or_damaged_message_is_detected() {
    assert_eq!(faults(&[sent(Class::Bulk, 1, 1), got(Class::Bulk, 1, 2)]), [(Invented, 1)]);
    assert_eq!(faults(&[got(Class::Stream, 7, 1)]), [(Invented, 1)]);
    let mut notes = clean();
    notes.push((TWO, Note::Damaged { from: ONE, class: Class::Bulk, number: 4 }));
    assert_eq!(faults(&notes), [(Damaged, 1)]);
}

#[test]
fn missing_outcome_is_detected() {
    assert_eq!(faults(&[asked(1, 1), got(Class::Control, 1, 1)]), [(OutcomeMissing, 1)]);
}

#[test]
fn second_outcome_is_detected_even_if_equal() {
    for outcome in [Outcome::Delivered, Outcome::Unknown] {
        let mut notes = clean();
        notes.push(ended(2, outcome));
        assert_eq!(faults(&notes), [(OutcomeTwice, 1)]);
    }
}

#[test]
fn false_delivered_is_detected_even_with_an_excused_loss() {
    let notes = [asked(1, 1), ended(1, Outcome::Delivered)];
    assert_eq!(faults(&notes), [(Lost, 1), (DeliveredAndNotGot, 1)]);
    assert_eq!(faults(&[notes[0], notes[1], lost([1, 0, 0])]), [(DeliveredAndNotGot, 1)]);
}

#[test]
fn false_denial_of_a_received_message_is_detected() {
    for denial in [Outcome::Expired, Outcome::PeerLost, Outcome::Rejected(Rejection::QueueFull)] {
        let notes = [asked(1, 1), got(Class::Control, 1, 1), ended(1, denial), lost([1, 0, 0])];
        assert_eq!(faults(&notes), [(GotAndDenied, 1)], "{denial:?}");
        let verdict = history(&[notes[0], notes[2], notes[3]]).verdict();
        assert!(verdict.holds() && !verdict.is_perfect() && verdict.told == 1, "{verdict}");
    }
}

#[test]
fn unknown_outcome_requires_a_later_node_loss() {
    for outcome in [Outcome::Unknown, Outcome::Failed] {
        const LAST: u64 = 2_000;
        let mut notes = vec![asked(1, LAST), got(Class::Control, 1, LAST), ended(LAST, outcome)];
        notes.extend((1..LAST).map(|number| ended(number, Outcome::Delivered)));
        let with = |note: (Party, Note)| faults(&[&notes[..], &[note]].concat());
        assert_eq!(faults(&notes), [(UnknownWithoutLoss, 1)], "{outcome:?}");
        assert_eq!(with(lost([1, 0, 0])), [(UnknownWithoutLoss, 1)], "{outcome:?}");
        assert_eq!(with(lost([LAST, 0, 0])), []);
        assert_eq!(with((TWO, Note::PeerLost { to: 1, upto: [0; 3] })), []);
    }
}

#[test]
fn peer_lost_outcome_requires_a_node_loss() {
    let notes = [asked(1, 1), ended(1, Outcome::PeerLost)];
    assert_eq!(faults(&notes), [(UnknownWithoutLoss, 1)]);
    assert_eq!(faults(&[notes[0], notes[1], lost([1, 0, 0])]), []);
}

/// A note that the second incarnation of the destination received these messages.
fn got_later(first: u64, count: u64) -> (Party, Note) {
    (Party { incarnation: 2, ..TWO }, Note::Got { from: ONE, class: Class::Bulk, first, count })
}

#[test]
fn kill_excuses_loss_only_between_two_incarnations() {
    let judge = |notes: &[(Party, Note)]| {
        let mut killed = history(&[&[sent(Class::Bulk, 1, 20), lost([0, 0, 12])], notes].concat());
        killed.killed(TWO);
        killed.verdict().faults.into_iter().collect::<Vec<_>>()
    };
    assert_eq!(judge(&[got(Class::Bulk, 1, 8), got_later(13, 8)]), []);
    assert_eq!(judge(&[got(Class::Bulk, 1, 8)]), []);
    let early = [got(Class::Bulk, 1, 3), got(Class::Bulk, 6, 5), got_later(11, 10)];
    assert_eq!(judge(&early), [(Lost, 2)]);
    assert_eq!(judge(&[early[0], early[1], got_later(13, 8)]), [(Lost, 2)]);
    let late = [got(Class::Bulk, 1, 10), got_later(11, 3), got_later(16, 5)];
    assert_eq!(judge(&late), [(Lost, 2)]);
}

#[test]
fn kill_before_the_first_message_uses_no_excuse() {
    let faults = |got: &[(Party, Note)]| {
        let mut killed = history(&[&[sent(Class::Bulk, 1, 20), lost([0, 0, 12])], got].concat());
        killed.killed(TWO);
        killed.verdict().faults.into_iter().collect::<Vec<_>>()
    };
    assert_eq!(faults(&[got_later(1, 6), got_later(9, 12)]), []);
    assert_eq!(faults(&[got_later(1, 6), got_later(9, 10)]), [(Lost, 2)]);
}

#[test]
fn loss_of_former_incarnation_does_not_excuse_later() {
    let later = Party { incarnation: 2, ..ONE };
    let from_later = |first, count| (TWO, Note::Got { from: later, class: Class::Bulk, first, count });
    let notes = [
        sent(Class::Bulk, 1, 3),
        got(Class::Bulk, 1, 3),
        (later, Note::Sent { to: 2, class: Class::Bulk, first: 1, count: 10, asked: false }),
        (TWO, Note::PeerLost { to: 1, upto: [0; 3] }),
        from_later(1, 4),
        from_later(7, 4),
    ];
    assert_eq!(faults(&notes), [(Lost, 2)]);
}

#[test]
fn loss_before_source_was_declared_lost_is_not_excused() {
    let given_up = (TWO, Note::PeerLost { to: 1, upto: [0; 3] });
    let notes = [sent(Class::Bulk, 1, 10), got(Class::Bulk, 1, 3), got(Class::Bulk, 5, 2)];
    assert_eq!(faults(&[notes[0], notes[1], given_up, notes[2], got(Class::Bulk, 7, 4)]), []);
    assert_eq!(faults(&[notes[0], notes[1], notes[2], given_up, got(Class::Bulk, 7, 4)]), [(Lost, 1)]);
}

#[test]
fn reported_loss_excuses_one_earlier_range() {
    let bulk = |upto| lost([0, 0, upto]);
    let tail = [sent(Class::Bulk, 1, 10), got(Class::Bulk, 1, 4)];
    assert_eq!(faults(&[tail[0], tail[1], bulk(10)]), []);
    let behind_it = [tail[0], tail[1], bulk(4)];
    assert_eq!(faults(&behind_it), [(Lost, 6)]);
    let two_rows = [tail[0], tail[1], got(Class::Bulk, 6, 2), bulk(10)];
    assert_eq!(faults(&two_rows), [(Lost, 3)]);
    let verdict = history(&[two_rows[0], two_rows[1], two_rows[2], two_rows[3], bulk(10)]).verdict();
    assert!(verdict.holds() && verdict.lost_with_node == 4, "{verdict}");
}

#[test]
fn loss_of_the_source_excuses_one_range() {
    let lost = (TWO, Note::PeerLost { to: 1, upto: [0; 3] });
    let notes =
        [sent(Class::Bulk, 1, 10), got(Class::Bulk, 1, 4), got(Class::Bulk, 6, 3), got(Class::Bulk, 10, 1)];
    assert_eq!(faults(&[notes[0], notes[1], lost, notes[2], notes[3]]), [(Lost, 1)]);
    assert_eq!(faults(&[notes[0], notes[1], lost, notes[2], lost, notes[3]]), []);
    let unknown = [asked(1, 1), got(Class::Control, 1, 1), ended(1, Outcome::Unknown)];
    assert_eq!(faults(&[unknown[0], unknown[1], lost, unknown[2]]), []);
}

#[test]
fn stream_may_lose_all_but_the_newest() {
    let notes = [sent(Class::Stream, 1, 10), got(Class::Stream, 3, 1), got(Class::Stream, 10, 1)];
    let verdict = history(&notes).verdict();
    assert!(verdict.is_perfect() && verdict.superseded == 8, "{verdict}");
    assert_eq!(faults(&notes[..2]), [(Lost, 7)]);
}

#[test]
fn killed_source_may_lose_only_its_last_messages() {
    let mut killed = history(&[sent(Class::Bulk, 1, 10), got(Class::Bulk, 1, 6), asked(1, 1)]);
    killed.killed(ONE);
    let verdict = killed.verdict();
    assert!(verdict.holds() && verdict.lost_with_node == 5 && verdict.ended_with_source == 1, "{verdict}");
    // The source was killed before it noted that it had sent these.
    killed.note(TWO, Note::Got { from: ONE, class: Class::Bulk, first: 7, count: 5 });
    assert!(killed.verdict().holds(), "{}", killed.verdict());
    killed.note(TWO, Note::Got { from: ONE, class: Class::Bulk, first: 13, count: 1 });
    assert_eq!(killed.verdict().count(Lost), 1);
}

#[test]
fn impossible_notes_are_detected() {
    assert_eq!(faults(&[sent(Class::Bulk, 2, 1)]), [(WrongNote, 1)]);
    assert_eq!(faults(&[ended(1, Outcome::Delivered)]), [(WrongNote, 1)]);
}

#[test]
fn every_note_survives_a_round_trip() {
    let mut notes = clean();
    notes.extend([lost([1, 2, 3]), ended(9, Outcome::Rejected(Rejection::Down))]);
    notes.push((TWO, Note::Damaged { from: ONE, class: Class::Stream, number: 4 }));
    for (_, note) in notes {
        assert_eq!(note.to_string().parse(), Ok(note));
    }
    for nonsense in ["", "got 1 2", "sent 1 9 1 1", "ended 1 0 1 99", "sent x"] {
        assert!(nonsense.parse::<Note>().is_err(), "{nonsense}");
    }
}

proptest! {
    /// Starting from a complete sequence, one message is dropped, duplicated or delayed.
    #[test]
    fn any_tampered_message_is_detected(
        count in 2_u64..200, which in any::<prop::sample::Index>(), how in 0_usize..3,
    ) {
        let one = which.index(count as usize - 1) as u64 + 1;
        let mut numbers: Vec<u64> = (1..=count).collect();
        let index = one as usize - 1;
        let fault = match how {
            0 => {
                numbers.remove(index);
                Lost
            }
            1 => {
                numbers.push(one);
                Duplicated
            }
            _ => {
                numbers.swap(index, index + 1);
                Reordered
            }
        };
        let mut notes = vec![sent(Class::Bulk, 1, count)];
        notes.extend(numbers.into_iter().map(|number| got(Class::Bulk, number, 1)));
        prop_assert_eq!(faults(&notes), [(fault, 1)]);
    }
}
