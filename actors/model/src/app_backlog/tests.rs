use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;

const APP: AppAddress = AppAddress::new(0x1000);
const OTHER: AppAddress = AppAddress::new(0x1001);

fn registered(app: AppAddress, name: &str) -> AppFact {
    AppFact::own_registered(app, Some(name.to_owned()), Vec::new())
}

const fn ready(app: AppAddress) -> AppFact {
    AppFact::Ready { app }
}

const fn down(app: AppAddress) -> AppFact {
    AppFact::Down { app }
}

const fn gone(app: AppAddress) -> AppFact {
    AppFact::Unregistered { app }
}

/// Repeats these facts this many times.
fn again_and_again(facts: &[AppFact], times: usize) -> Vec<AppFact> {
    (0..times).flat_map(|_| facts.to_vec()).collect()
}

fn delivered(backlog: &mut EventBacklog<Reader>) -> Vec<AppFact> {
    let mut delivered = Vec::new();
    assert!(backlog.offer(|fact| {
        delivered.push(fact.clone());
        true
    }));
    delivered
}

/// Returns the facts for a reader that knows `known` and reads again, after all of `happened`.
fn kept(reader: Reader, known: &[AppFact], happened: &[AppFact]) -> Vec<AppFact> {
    let mut backlog = EventBacklog::new(reader, 2 * PER_APP_MAX + 1);
    known.iter().for_each(|fact| _ = backlog.push(fact.clone()));
    delivered(&mut backlog);
    for fact in happened {
        backlog.push(fact.clone());
        assert!(!backlog.offer(|_| false) || backlog.is_empty());
    }
    delivered(&mut backlog)
}

#[test]
fn rejected_facts_are_reported_before_later_ones() {
    let happened = [registered(APP, "drive"), registered(OTHER, "gait"), ready(APP), ready(OTHER)];
    assert_eq!(kept(Reader::Sync, &[], &happened), happened);
}

#[test]
fn ended_incarnation_is_reported_once_then_the_present_state() {
    let known = [registered(APP, "drive"), ready(APP)];
    let fails = [down(APP), ready(APP)];
    assert_eq!(kept(Reader::Sync, &known, &again_and_again(&fails, 9)), [down(APP), ready(APP)]);
    assert_eq!(kept(Reader::Ndl, &known[1..], &again_and_again(&fails, 9)), [down(APP), ready(APP)]);
    let stopped = AppFact::Stopped { app: APP };
    assert_eq!(kept(Reader::Sync, &known, &[down(APP), ready(APP), stopped.clone()]), [stopped]);
    let comes_again = [gone(APP), registered(APP, "drive"), ready(APP)];
    assert_eq!(kept(Reader::Sync, &known, &again_and_again(&comes_again, 9)), comes_again);
    assert_eq!(kept(Reader::Sync, &known, &again_and_again(&comes_again[..2], 2)), comes_again[..2]);
}

#[test]
fn short_lived_applications_are_omitted_and_known_ends_kept() {
    let (came, went) = ([registered(OTHER, "gait"), ready(OTHER)], [down(OTHER), gone(OTHER)]);
    let happened = [&came[..], &[gone(APP)], &went[..]].concat();
    assert_eq!(kept(Reader::Sync, &[registered(APP, "drive")], &happened), [gone(APP)]);
    assert_eq!(kept(Reader::Ndl, &[ready(APP)], &happened), [gone(APP)]);
    assert_eq!(kept(Reader::Ndl, &[], &[down(APP), gone(APP)]), []);
}

#[test]
fn new_holder_of_a_name_follows_the_formers_end() {
    let known = [registered(APP, "drive")];
    // The later end of the same address does not go behind the newcomer.
    let happened =
        [gone(APP), registered(OTHER, "drive"), registered(APP, "gait"), gone(APP), registered(APP, "knee")];
    let last = [gone(APP), registered(OTHER, "drive"), registered(APP, "knee")];
    assert_eq!(kept(Reader::Sync, &known, &happened), last);
}

#[test]
fn handled_kinds_are_kept_until_their_application_ends() {
    use sinew_runtime::wire::Kind;
    let handles = |kind| AppFact::Handles { app: APP, kinds: vec![Kind::named(kind)] };
    let known = [registered(APP, "drive")];
    let happened = [handles("a"), ready(APP), handles("b")];
    assert_eq!(kept(Reader::Sync, &known, &happened), [ready(APP), handles("b")]);
    assert_eq!(kept(Reader::Sync, &known, &[handles("a"), gone(APP)]), [gone(APP)]);
    assert_eq!(kept(Reader::Sync, &[], &[AppFact::GroupsChanged, AppFact::GroupsChanged]).len(), 1);
}

#[test]
fn last_declared_types_replace_the_former() {
    use crate::facts::DeclaredTypes;
    use sinew_runtime::wire::{Kind, SchemaHash};
    let types = |hash| {
        let sends = vec![(Kind::named("a"), SchemaHash(hash))];
        AppFact::Types { app: APP, types: DeclaredTypes { sends, ..DeclaredTypes::default() } }
    };
    let known = [registered(APP, "drive")];
    assert_eq!(kept(Reader::Sync, &known, &[types(1), ready(APP), types(2)]), [ready(APP), types(2)]);
    assert_eq!(kept(Reader::Sync, &known, &[types(1), gone(APP)]), [gone(APP)]);
}

/// What a reader knows of each application: whether it is ready.
#[derive(Debug, Default, PartialEq, Eq)]
struct Known(BTreeMap<AppAddress, bool>);

impl Known {
    fn handle(&mut self, reader: Reader, fact: &AppFact) {
        let Some(app) = reader.subject(fact) else { return };
        match reader.role(fact) {
            Role::Begins(()) => _ = self.0.insert(app, matches!(fact, AppFact::Ready { .. })),
            Role::Ends(()) => _ = self.0.remove(&app),
            Role::Changes | Role::Standalone => {
                if let Some(is_ready) = self.0.get_mut(&app) {
                    *is_ready = matches!(fact, AppFact::Ready { .. });
                }
            }
        }
    }
}

proptest! {
    /// Each step is a change of one of three applications, after which the reader takes so many facts.
    #[test]
    fn reader_ends_with_the_true_applications(
        steps in prop::collection::vec((0_u32..3, 0_u8..3, 0_usize..4), 0..64)
    ) {
        for reader in [Reader::Sync, Reader::Ndl] {
            let capacity = 3 * PER_APP_MAX + 1;
            let mut backlog = EventBacklog::new(reader, capacity);
            let (mut truth, mut known) = (Known::default(), Known::default());
            let (mut happened, mut delivered) = (Vec::new(), Vec::new());
            let mut apps = [None; 3];
            for (index, kind, room) in &steps {
                let app = AppAddress::new(0x1000 + index);
                let is_ready = &mut apps[*index as usize];
                let fact = match (*is_ready, kind) {
                    (None, _) => registered(app, "drive"),
                    (Some(true), 0) => down(app),
                    (Some(false), 0) => ready(app),
                    (Some(_), 1) => gone(app),
                    (Some(_), _) => AppFact::Stopped { app },
                };
                let is_registered = !matches!(fact, AppFact::Unregistered { .. });
                *is_ready = is_registered.then_some(matches!(fact, AppFact::Ready { .. }));
                truth.handle(reader, &fact);
                happened.push(fact.clone());
                backlog.push(fact);
                prop_assert!(backlog.len() <= capacity);
                let mut room = *room;
                backlog.offer(|fact| {
                    let is_taken = room > 0;
                    if is_taken {
                        delivered.push(fact.clone());
                        room -= 1;
                    }
                    is_taken
                });
            }
            delivered.extend(self::delivered(&mut backlog));
            delivered.iter().for_each(|fact| known.handle(reader, fact));
            prop_assert_eq!(&known, &truth);
        }
    }
}
