//! What guests may have of their node's barriers and of its list: room is left to the robot's own applications, whatever guests do.

use proptest::prelude::*;

use super::*;
use crate::{
    lncl::User,
    sync::{
        arrivals::BARRIERS_MAX,
        list::ENTRIES_MAX,
        words::{BarrierKind, OnPartyLoss},
    },
};

/// Users whom the access list lets in.
const USER: u32 = 1_001;
const ANOTHER: u32 = 1_002;
const THIRD: u32 = 1_003;
/// Barriers of one guest, of one user's guests, of all guests.
const OF_ONE: usize = 16;
const OF_USER: usize = 32;
const OF_ALL: usize = 64;

impl Bench {
    /// An application of another user registers. Application 0 is "hip", and the robot's own.
    fn guest(&mut self, index: u32, uid: u32) -> Vec<Output> {
        let (name, user) = (Some(format!("guest.{index}")), User::Guest(uid));
        let fact = AppFact::Registered { app: app(index), name, requires: Vec::new(), user };
        [self.hears(Input::AppChanged(fact)), self.ready(index)].concat()
    }

    fn ends(&mut self, index: u32) {
        self.hears(Input::AppChanged(AppFact::Unregistered { app: app(index) }));
    }

    /// It arrives, waits for 1 ms and gives up; why it was refused, if it was.
    fn visits(&mut self, index: u32, barrier: &str, parties: &[&str]) -> Option<String> {
        let asked = ArriveAtBarrier {
            kind: BarrierKind::Meeting,
            barrier: barrier.to_owned(),
            parties: parties.iter().map(|party| (*party).to_owned()).collect(),
            within_ms: 1,
            on_loss: OnPartyLoss::Wait,
        };
        let outputs = self.hears(Input::Arrived { app: app(index), correlation: 7, asked });
        self.passes(Duration::from_millis(2));
        outputs.into_iter().find_map(|output| {
            let Output::AnswerBarrier { answer: BarrierAnswer::Refused { why }, .. } = output else {
                return None;
            };
            Some(why)
        })
    }

    /// It visits so many barriers, which are called after it; why it was refused.
    fn visits_many(&mut self, index: u32, count: usize) -> Vec<String> {
        let visits = |number: usize| self.visits(index, &format!("{index}, {number}"), &["*", "nobody"]);
        (0..count).filter_map(visits).collect()
    }

    fn barriers_with_guests(&self) -> usize {
        self.core.rendezvous.known.values().filter(|known| !known.guests.is_empty()).count()
    }
}

// spec: SYNC-10
#[test]
fn a_guest_that_visits_a_barrier_of_every_name_leaves_all_but_16_to_others() {
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
fn guests_of_one_user_have_half_of_what_guests_have_and_all_guests_a_quarter() {
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
fn what_guests_have_is_given_back_when_they_end() {
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
fn a_guest_that_is_a_party_of_the_robots_barrier_passes_it_with_the_robot() {
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
        bench.hears(Input::Arrived { app: app(index), correlation: 7, asked })
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
fn barriers_of_guests_take_a_quarter_of_a_nodes_word_at_most() {
    // Given: barriers each of which takes a fourteenth of the word
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
fn where_the_list_has_no_room_for_all_guests_are_left_out_first() {
    // Given
    let mut config = NodeConfig::new("hip");
    config.payload_max = 4_096;
    let core = Core::new(&config, HERE, Incarnation(1));
    let mut bench = Bench { core, now: Time::from_nanos(1_000_000_000), misspelt: Vec::new() };
    (1..=200).for_each(|index| drop(bench.guest(index, USER)));
    bench.registers(0, "toe", &[]);
    // And: as many of the robot's own as there is room for, but not beside the groups that only guests are in
    for index in 201..=280 {
        bench.registers(index, &format!("own.{index}"), &[]);
    }
    let groups: Vec<_> = (0..129).map(|number| AppAddress::new(0xf000_0000 + number)).collect();
    bench.hears(Input::GroupsChanged(Published { groups: groups.clone(), own: 1, ..Published::default() }));
    // When
    let outputs = [bench.links(KNEE, LIFE), bench.passes(SPACING)].concat();
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
fn no_list_that_is_said_lacks_a_name_of_the_robots_own_because_a_guest_has_come() {
    // Given: a list with as many of the robot's own as there may be in one, which a peer has, so that each change is said at once
    let mut bench = Bench::new();
    let names: Vec<String> = (0..ENTRIES_MAX).map(|number| format!("own.{number:04}")).collect();
    for (index, name) in (0..).zip(&names) {
        bench.registers(index, name, &[]);
    }
    bench.links(KNEE, LIFE);
    bench.passes(REPEAT);
    bench.now = bench.now + REPEAT / 2;
    // When: a guest comes whose name stands before all of theirs
    let comes = bench.guest(2_000, USER);
    let lists = published(&[comes, bench.passes(REPEAT)].concat());
    // Then: in the first one that is said of it, too
    assert!(lists.len() > 1, "{} lists", lists.len());
    for list in lists {
        assert!(list.entries.iter().map(|entry| &*entry.name).eq(names.iter()), "version {}", list.version);
    }
}

// spec: SYNC-4
#[test]
fn whose_an_application_is_counts_also_where_nothing_else_of_it_is_new() {
    // Given: a guest that was one of the robot's own before, by the same name
    let mut bench = Bench::new();
    bench.registers(1, "guest.1", &[]);
    bench.guest(1, USER);
    // Then
    assert_eq!(bench.core.apps.get(app(1)).map(|app| app.user), Some(User::Guest(USER)));
}

/// What happens to one of some applications.
#[derive(Clone, Copy, Debug)]
enum Act {
    Comes(u32),
    Visits(u32, u16),
    Ends(u32),
}

fn act() -> impl Strategy<Value = Act> {
    let guest = || 1..16_u32;
    prop_oneof![
        2 => guest().prop_map(Act::Comes),
        9 => (0..16_u32, 0..400_u16).prop_map(|(index, barrier)| Act::Visits(index, barrier)),
        1 => guest().prop_map(Act::Ends),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    // spec: SYNC-10
    #[test]
    fn whatever_guests_do_the_robots_own_arrive(acts in proptest::collection::vec(act(), 0..400)) {
        let mut bench = Bench::of_the_hip();
        for act in acts {
            match act {
                Act::Comes(index) => drop(bench.guest(index, USER + index % 3)),
                Act::Ends(index) => bench.ends(index),
                // The robot's own is at as many as are left to it, some of them with guests.
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
