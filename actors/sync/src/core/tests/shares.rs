//! The shares of guests in the barriers of their node and in its list. The robot's own applications keep room,
//! regardless of the actions of guests.

use proptest::prelude::*;
use sinew_model::{
    barrier::{BarrierKind, OnPartyLoss},
    facts::User,
};

use super::*;
use crate::{arrivals::BARRIERS_MAX, list::ENTRIES_MAX};

/// Users that the access list admits.
const USER: u32 = 1_001;
const ANOTHER: u32 = 1_002;
const THIRD: u32 = 1_003;
/// Barriers of one guest, of one user's guests, of all guests.
const OF_ONE: usize = 16;
const OF_USER: usize = 32;
const OF_ALL: usize = 64;

impl Bench {
    /// Registers an application of another user. Application 0 is "hip", one of the robot's own.
    fn guest(&mut self, index: u32, uid: u32) -> Vec<Output> {
        let (name, user) = (Some(format!("guest.{index}")), User::Guest(uid));
        let fact = AppFact::Registered { app: app(index), name, requires: Vec::new(), user };
        [self.handle(Input::AppChanged(fact)), self.ready(index)].concat()
    }

    fn ends(&mut self, index: u32) {
        self.handle(Input::AppChanged(AppFact::Unregistered { app: app(index) }));
    }

    /// The application arrives, waits for 1 ms and gives up. Returns the reason of a rejection, if any.
    fn visits(&mut self, index: u32, barrier: &str, parties: &[&str]) -> Option<String> {
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: barrier.to_owned(),
            parties: parties.iter().map(|party| (*party).to_owned()).collect(),
            within_ms: 1,
            on_loss: OnPartyLoss::Wait,
        };
        let outputs = self.handle(Input::Arrived { app: app(index), correlation: 7, asked });
        self.passes(Duration::from_millis(2));
        outputs.into_iter().find_map(|output| {
            let Output::AnswerBarrier { answer: BarrierAnswer::Refused { why }, .. } = output else {
                return None;
            };
            Some(why)
        })
    }

    /// Visits this many barriers, which are named after the application. Returns the reasons of rejections.
    fn visits_many(&mut self, index: u32, count: usize) -> Vec<String> {
        let visits = |number: usize| self.visits(index, &format!("{index}, {number}"), &["*", "nobody"]);
        (0..count).filter_map(visits).collect()
    }

    fn barriers_with_guests(&self) -> usize {
        self.core.rendezvous().barriers.values().filter(|known| !known.guests.is_empty()).count()
    }
}

// spec: SYNC-10
#[test]
fn guest_can_hold_at_most_16_barriers() {
    // Given
    let mut bench = Bench::of_the_hip();
    bench.guest(1, USER);
    // When
    let refused = bench.visits_many(1, BARRIERS_MAX);
    // Then
    assert_eq!(refused.len(), BARRIERS_MAX - OF_ONE);
    assert!(refused.iter().all(|why| why.contains("16 barriers") && why.contains("1001")), "{}", refused[0]);
    assert_eq!(bench.visits_many(1, OF_ONE), [""; 0], "where it is it may come again");
    assert_eq!(bench.visits_many(0, BARRIERS_MAX - OF_ONE), [""; 0]);
}

// spec: SYNC-10
#[test]
fn guests_share_a_quarter_and_one_user_half() {
    // Given
    let mut bench = Bench::of_the_hip();
    for (index, uid) in [(1, USER), (2, USER), (3, USER), (4, ANOTHER), (5, ANOTHER), (6, THIRD)] {
        bench.guest(index, uid);
    }
    // When
    let refused: Vec<Vec<String>> = (1..=6).map(|index| bench.visits_many(index, OF_ONE)).collect();
    // Then
    let counts: Vec<usize> = refused.iter().map(Vec::len).collect();
    assert_eq!(counts, [0, 0, OF_ONE, 0, 0, OF_ONE]);
    assert!(refused[2][0].contains("user 1001") && refused[2][0].contains("32"), "{}", refused[2][0]);
    assert!(refused[5][0].contains("64 barriers"), "{}", refused[5][0]);
    assert_eq!(OF_USER * 2, bench.barriers_with_guests());
    assert_eq!(bench.visits_many(0, BARRIERS_MAX - OF_ALL), [""; 0], "these are for the robot's own");
    assert!(bench.visits(0, "one more", &["*", "nobody"]).is_some());
}

// spec: SYNC-10
#[test]
fn guests_shares_are_released_when_they_end() {
    let mut bench = Bench::of_the_hip();
    for round in 0..20 {
        let (first, second) = (1 + 2 * round, 2 + 2 * round);
        bench.guest(first, USER);
        bench.guest(second, USER);
        assert_eq!([bench.visits_many(first, OF_ONE), bench.visits_many(second, OF_ONE)].concat(), [""; 0]);
        bench.ends(first);
        bench.ends(second);
        assert_eq!(bench.barriers_with_guests(), 0);
    }
    assert_eq!(bench.visits_many(0, BARRIERS_MAX), [""; 0]);
}

// spec: SYNC-10
#[test]
fn guest_that_is_a_party_passes_with_the_robot() {
    let mut bench = Bench::of_the_hip();
    bench.guest(1, USER);
    let mut arrives = |index| {
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: "calibrated".to_owned(),
            parties: ["hip", "guest.1"].map(str::to_owned).to_vec(),
            within_ms: 1_000,
            on_loss: OnPartyLoss::Wait,
        };
        bench.handle(Input::Arrived { app: app(index), correlation: 7, asked })
    };
    assert_eq!(arrives(1), []);
    let opened = |index| Output::AnswerBarrier {
        app: app(index),
        correlation: 7,
        answer: BarrierAnswer::Opened { generation: 1 },
    };
    assert_eq!(arrives(0), [opened(0), opened(1)]);
}

// spec: SYNC-10
#[test]
fn guest_barriers_take_at_most_a_quarter() {
    // Given: barriers that each take a fourteenth of the frame
    let parties = ["*", "1000 of *"];
    let mut bench = Bench::of_the_hip();
    bench.guest(1, USER);
    // When
    let refused: Vec<_> =
        (0..5).filter_map(|number| bench.visits(1, &format!("{number}"), &parties)).collect();
    // Then
    assert_eq!(refused.len(), 2);
    assert!(refused[0].contains("`node.payload_max`"), "{}", refused[0]);
    let own = (0..10).filter_map(|number| bench.visits(0, &format!("own {number}"), &parties));
    assert_eq!(own.count(), 0);
}

// spec: SYNC-4
#[test]
fn full_list_leaves_out_guests_first() {
    // Given
    let mut config = NodeConfig::new("hip");
    config.payload_max = 4_096;
    let core = Core::new(&config, HERE, Incarnation(1));
    let mut bench = Bench { core, now: Time::from_nanos(1_000_000_000), misspelt: Vec::new() };
    (1..=200).for_each(|index| drop(bench.guest(index, USER)));
    bench.registers(0, "toe", &[]);
    // And: as many of the robot's own as fit, except beside the groups that have guests only
    for index in 201..=280 {
        bench.registers(index, &format!("own.{index}"), &[]);
    }
    let groups: Vec<_> = (0..129).map(|number| AppAddress::new(0xf000_0000 + number)).collect();
    bench.handle(Input::GroupsChanged(Published { groups: groups.clone(), own: 1, ..Published::default() }));
    // When
    let outputs = [bench.links(KNEE, INCARNATION), bench.passes(SPACING)].concat();
    // Then
    let lists = published(&outputs);
    let list = &lists[lists.len() - 1];
    let names: Vec<&str> = list.entries.iter().map(|entry| &*entry.name).collect();
    assert!(names.contains(&"toe") && names.len() < 281, "{names:?}");
    assert_eq!(names.iter().filter(|name| name.starts_with("own.")).count(), 80, "{names:?}");
    assert_eq!(list.groups, groups[..1], "the robot's own");
}

// spec: SYNC-4
#[test]
fn no_list_loses_an_own_name_to_guests() {
    // Given: a list with the maximum number of the robot's own applications, which a peer has, so each change is
    // published at once
    let mut bench = Bench::new();
    let names: Vec<String> = (0..ENTRIES_MAX).map(|number| format!("own.{number:04}")).collect();
    for (index, name) in (0..).zip(&names) {
        bench.registers(index, name, &[]);
    }
    bench.links(KNEE, INCARNATION);
    bench.passes(REPEAT);
    bench.now = bench.now + REPEAT / 2;
    // When: a guest comes with a name that sorts before all of theirs
    let comes = bench.guest(2_000, USER);
    let lists = published(&[comes, bench.passes(REPEAT)].concat());
    // Then: the first list that is published about it has them all, too
    assert!(lists.len() > 1, "{} lists", lists.len());
    for list in lists {
        assert!(list.entries.iter().map(|entry| &*entry.name).eq(names.iter()), "version {}", list.version);
    }
}

// spec: SYNC-4
#[test]
fn changed_user_counts_where_nothing_else_is_new() {
    // Given: a guest that was one of the robot's own applications before, by the same name
    let mut bench = Bench::new();
    bench.registers(1, "guest.1", &[]);
    bench.guest(1, USER);
    // Then
    assert_eq!(bench.core.apps.get(app(1)).map(|app| app.user), Some(User::Guest(USER)));
}

/// An action of one of some applications.
#[derive(Clone, Copy, Debug)]
enum Act {
    Registers(u32),
    Visits(u32, u16),
    Ends(u32),
}

fn act() -> impl Strategy<Value = Act> {
    let guest = || 1..16_u32;
    prop_oneof![
        2 => guest().prop_map(Act::Registers),
        9 => (0..16_u32, 0..400_u16).prop_map(|(index, barrier)| Act::Visits(index, barrier)),
        1 => guest().prop_map(Act::Ends),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    // spec: SYNC-10
    #[test]
    fn own_applications_arrive_regardless_of_guests(acts in proptest::collection::vec(act(), 0..400)) {
        let mut bench = Bench::of_the_hip();
        for act in acts {
            match act {
                Act::Registers(index) => drop(bench.guest(index, USER + index % 3)),
                Act::Ends(index) => bench.ends(index),
                // The robot's own application is at the number of barriers left to it, at some of them with guests.
                Act::Visits(0, barrier) => {
                    let barrier = usize::from(barrier) % (BARRIERS_MAX - OF_ALL);
                    let refused = bench.visits(0, &format!("{barrier}"), &["*", "nobody"]);
                    prop_assert!(refused.is_none(), "{refused:?}");
                }
                Act::Visits(index, barrier) => {
                    bench.visits(index, &format!("{barrier}"), &["*", "nobody"]);
                }
            }
            prop_assert!(bench.barriers_with_guests() <= OF_ALL);
        }
    }
}
