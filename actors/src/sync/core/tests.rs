//! What the sync manager promises, one claim a test.

use std::net::SocketAddr;

#[path = "barriers_tests.rs"]
mod barriers;
#[path = "directory_tests.rs"]
mod directory;
#[path = "forms_tests.rs"]
mod forms;
#[path = "lives_tests.rs"]
mod lives;
#[path = "phases_tests.rs"]
mod phases;
#[path = "publish_tests.rs"]
mod publish;
#[path = "shares_tests.rs"]
mod shares;
#[path = "stalls_tests.rs"]
mod stalls;

use self::forms::in_words;
use super::{
    barrier::{RETRY, SILENCE},
    peers::{REPEAT, SPACING},
    *,
};
use crate::{
    ndl::LossReason,
    sync::list::{Entry, List, Name},
};

const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
const KNEE: NodeAddress = NodeAddress::new(0x7f00_0002);
const ANKLE: NodeAddress = NodeAddress::new(0x7f00_0003);
const LIFE: Incarnation = Incarnation(5);
const NEXT_LIFE: Incarnation = Incarnation(6);

/// A core and its clock.
struct Bench {
    core: Core,
    now: Time,
    /// Reports of names that nobody has: who waits, for which, and similar ones.
    misspelt: Vec<(String, String, Vec<String>)>,
}

impl Bench {
    fn new() -> Self {
        let core = Core::new(&NodeConfig::new("hip"), HERE, Incarnation(1));
        Self { core, now: Time::from_nanos(1_000_000_000), misspelt: Vec::new() }
    }

    /// Application 0 is "gait" and requires "sensor", which is application 1; both are ready.
    fn where_gait_runs_with_its_sensor() -> Self {
        let mut bench = Self::new();
        bench.registers(0, "gait", &["sensor"]);
        bench.registers(1, "sensor", &[]);
        bench.ready(1);
        bench.ready(0);
        bench
    }

    fn hears(&mut self, input: Input) -> Vec<Output> {
        self.core.handle(self.now, input);
        let mut outputs = Vec::new();
        while let Some(output) = self.core.poll() {
            if let Output::Misspelt { application, name, nearest } = output {
                self.misspelt.push((application, name, nearest));
            } else {
                outputs.push(output);
            }
        }
        outputs
    }

    fn registers(&mut self, index: u32, name: &str, requires: &[&str]) -> Vec<Output> {
        let requires = requires.iter().map(|name| (*name).to_owned()).collect();
        let name = (!name.is_empty()).then(|| name.to_owned());
        self.hears(Input::AppChanged(AppFact::own_registered(app(index), name, requires)))
    }

    fn ready(&mut self, index: u32) -> Vec<Output> {
        self.hears(Input::AppChanged(AppFact::Ready { app: app(index) }))
    }

    fn down(&mut self, index: u32) -> Vec<Output> {
        self.hears(Input::AppChanged(AppFact::Down { app: app(index) }))
    }

    fn links(&mut self, node: NodeAddress, incarnation: Incarnation) -> Vec<Output> {
        self.hears(Input::LinkChanged(LinkFact::LinkUp { node, incarnation }))
    }

    fn breaks(&mut self, node: NodeAddress) -> Vec<Output> {
        self.hears(Input::LinkChanged(LinkFact::LinkBroken { node, incarnation: LIFE }))
    }

    fn lost(&mut self, node: NodeAddress, why: LossReason) -> Vec<Output> {
        let lost = MembershipFact::NodeLost { node, incarnation: LIFE, why };
        self.hears(Input::MembershipChanged(lost))
    }

    fn list(&mut self, from: NodeAddress, list: List) -> Vec<Output> {
        self.hears(Input::ListReceived { from, payload: list.encode(usize::MAX).0 })
    }

    fn passes(&mut self, time: Duration) -> Vec<Output> {
        self.now = self.now + time;
        self.hears(Input::TimePassed)
    }

    /// The words about what keeps the first waiting application.
    fn missing(&self) -> Vec<(String, &'static str)> {
        in_words(self.core.waiting(self.now).remove(0).missing)
    }
}

fn app(index: u32) -> AppAddress {
    AppAddress::fixed(index).unwrap()
}

fn list(version: u64, entries: &[(&str, bool, &[&str])]) -> List {
    let name = |text: &str| Name::try_from(text.to_owned()).unwrap();
    let entries = (0..).zip(entries).map(|(index, (text, ready, requires))| Entry {
        name: name(text),
        app: app(index),
        ready: *ready,
        ended: None,
        phases: Vec::new(),
        requires: requires.iter().map(|text| text.parse().unwrap()).collect(),
        kinds: Vec::new(),
    });
    List { incarnation: LIFE, version, entries: entries.collect(), groups: Vec::new() }
}

fn release(index: u32) -> Output {
    Output::Release { app: app(index) }
}

fn lost(index: u32, name: &str, why: Reason) -> Output {
    let event = RequirementEvent::Lost { name: name.to_owned() };
    Output::Tell { app: app(index), event, why: Some(why) }
}

fn met(index: u32, name: &str) -> Output {
    Output::Tell { app: app(index), event: RequirementEvent::Met { name: name.to_owned() }, why: None }
}

fn published(outputs: &[Output]) -> Vec<List> {
    let mut lists = Vec::new();
    for output in outputs {
        if let Output::Publish { list, .. } = output {
            lists.push(List::parse(list).unwrap());
        }
    }
    lists
}

#[test]
fn who_requires_nothing_is_released_at_once() {
    assert_eq!(Bench::new().registers(0, "plant", &[]), [release(0)]);
}

// spec: SYNC-5
#[test]
fn an_application_is_released_when_the_last_of_its_requirements_is_ready() {
    let mut bench = Bench::new();
    assert_eq!(bench.registers(0, "gait", &["sensor", "knee.drive"]), []);
    assert_eq!(bench.registers(1, "sensor", &[]), [release(1)]);
    assert_eq!(bench.ready(1), []);
    bench.links(KNEE, LIFE);
    assert_eq!(bench.list(KNEE, list(1, &[("knee.drive", false, &[])])), []);
    assert_eq!(bench.list(KNEE, list(2, &[("knee.drive", true, &[])])), [release(0)]);
}

// spec: SYNC-5
#[test]
fn a_failed_application_waits_again_and_others_are_told_but_not_stopped() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    assert_eq!(bench.down(1), [lost(0, "sensor", Reason::Failed), release(1)]);
    assert_eq!(bench.ready(1), [met(0, "sensor")]);
    assert_eq!(bench.down(0), [release(0)], "all that it requires is ready still");
    assert_eq!(bench.registers(0, "gait", &["sensor"]), [], "told again");
    bench.down(1);
    assert_eq!(bench.registers(0, "gait", &["sensor", "sensor.left"]), [], "other requirements: a new life");
    bench.ready(1);
    bench.registers(2, "sensor.left", &[]);
    assert_eq!(bench.ready(2), [release(0)]);
}

// spec: SYNC-8
#[test]
fn a_running_application_hears_once_of_a_lost_node_and_once_of_its_return() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(3, &[("knee.drive", true, &[])]));
    bench.registers(0, "gait", &["knee.drive"]);
    bench.ready(0);
    assert_eq!(bench.lost(KNEE, LossReason::LinkDown), [lost(0, "knee.drive", Reason::NodeLost)]);
    assert_eq!(bench.breaks(KNEE), []);
    let back = bench.links(KNEE, NEXT_LIFE);
    assert!(!back.contains(&met(0, "knee.drive")), "a link alone says nothing about the application");
    let mut news = list(1, &[("knee.drive", true, &[])]);
    news.incarnation = NEXT_LIFE;
    assert_eq!(bench.list(KNEE, news), [met(0, "knee.drive")]);
}

/// Application 0 is "gait", runs, and requires "knee.drive", which is ready on the node of the knee.
fn where_gait_runs_with_a_drive_elsewhere() -> Bench {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(3, &[("knee.drive", true, &[])]));
    bench.registers(0, "gait", &["knee.drive"]);
    bench.ready(0);
    bench
}

// spec: SYNC-8
#[test]
fn a_layer_that_restarts_is_heard_of_again_before_anybody_is_told_of_a_loss() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    assert_eq!(bench.breaks(KNEE), []);
    assert_eq!(bench.passes(SILENCE / 3), []);
    assert_eq!(published(&bench.links(KNEE, LIFE)).len(), 1);
    assert_eq!(bench.passes(SILENCE / 3), [], "its list has not come yet");
    assert_eq!(bench.list(KNEE, list(3, &[("knee.drive", true, &[])])), []);
    let told: Vec<_> =
        bench.passes(REPEAT).into_iter().filter(|out| matches!(out, Output::Tell { .. })).collect();
    assert_eq!(told, []);
}

// spec: SYNC-8
#[test]
fn a_link_that_stays_down_is_a_loss_and_so_is_at_once_what_is_known_of_the_application() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    assert_eq!(bench.core.next_wake(), Some(bench.now + SILENCE));
    assert_eq!(bench.passes(SILENCE), [lost(0, "knee.drive", Reason::LinkDown)]);
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    assert_eq!(bench.lost(KNEE, LossReason::Crashed), [lost(0, "knee.drive", Reason::NodeLost)]);
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    bench.links(KNEE, LIFE);
    assert_eq!(
        bench.list(KNEE, list(4, &[("knee.drive", false, &[])])),
        [lost(0, "knee.drive", Reason::NotReady)]
    );
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    assert!(bench.links(KNEE, NEXT_LIFE).contains(&lost(0, "knee.drive", Reason::NodeRestarted)));
}

// spec: SYNC-8
#[test]
fn one_that_was_stopped_in_order_is_not_said_to_have_failed() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    let stopped = bench.hears(Input::AppChanged(AppFact::Stopped { app: app(1) }));
    assert_eq!(stopped, [lost(0, "sensor", Reason::Stopped), release(1)]);
    assert!(Reason::Stopped.is_orderly() && !Reason::Failed.is_orderly());
    assert_eq!(
        in_words(bench.core.missing(bench.now, app(0))),
        [("sensor".to_owned(), "stopped in order, not ready again")]
    );
}

// spec: SYNC-8
#[test]
fn an_application_that_failed_with_a_requirement_lost_is_told_in_its_next_life_that_it_is_met() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    bench.down(1);
    assert_eq!(bench.down(0), []);
    assert_eq!(bench.ready(1), [release(0), met(0, "sensor")]);
    assert_eq!(bench.ready(0), []);
}

// spec: SYNC-8
#[test]
fn what_is_lost_again_before_the_next_life_is_ready_is_told_to_that_life() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    bench.down(1);
    bench.down(0);
    assert_eq!(bench.ready(1), [release(0), met(0, "sensor")]);
    assert_eq!(bench.down(1), [lost(0, "sensor", Reason::Failed), release(1)]);
}

// spec: SYNC-8
#[test]
fn what_a_full_mailbox_did_not_take_is_offered_again_in_its_last_form() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    bench.down(1);
    let name = || "sensor".to_owned();
    assert_eq!(bench.hears(Input::EventNotTaken { app: app(0), name: name() }), []);
    assert_eq!(bench.passes(RETRY), [lost(0, "sensor", Reason::Failed)]);
    bench.hears(Input::EventNotTaken { app: app(0), name: name() });
    assert_eq!(bench.ready(1), [met(0, "sensor")]);
    assert_eq!(bench.passes(RETRY), [], "the lost one is out of date");
    bench.hears(Input::ReleaseNotTaken { app: app(2) });
    bench.registers(2, "late", &[]);
    bench.hears(Input::ReleaseNotTaken { app: app(2) });
    assert_eq!(bench.passes(RETRY), [release(2)]);
}

// spec: SYNC-9
// spec: SYNC-5
#[test]
fn a_release_that_was_not_taken_is_given_again_only_where_all_is_still_there() {
    let given = || {
        let mut bench = Bench::new();
        bench.registers(0, "sensor", &[]);
        bench.registers(1, "gait", &["sensor"]);
        assert!(bench.ready(0).contains(&release(1)));
        bench.hears(Input::ReleaseNotTaken { app: app(1) });
        bench.down(0);
        let again = bench.passes(RETRY);
        assert!(!again.contains(&release(1)), "{again:?}");
        bench
    };
    let mut bench = given();
    assert!(bench.ready(0).contains(&release(1)));
    assert_eq!(bench.ready(1), [], "nothing has changed for it");
    // It may have been taken all the same, and the application have started: then it hears of the loss.
    let mut bench = given();
    assert_eq!(bench.ready(1), [lost(1, "sensor", Reason::Failed)]);
    assert!(bench.ready(0).contains(&met(1, "sensor")));
}

#[test]
fn every_deadline_that_passes_reports_what_is_missing_since_when_and_why() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["sensor", "knee.drive"]);
    bench.registers(1, "sensor", &[]);
    let deadline = bench.core.next_wake().unwrap();
    assert_eq!(deadline, bench.now + Duration::from_secs(2), "first it is looked whether a name is misspelt");
    let waited = |seconds| {
        let since = Duration::from_secs(seconds);
        let absent =
            |(name, why): (&str, &'static str)| Absence { name: name.to_owned(), why: why.into(), since };
        let missing = [("sensor", "registered, not ready"), ("knee.drive", "not there")].map(absent).to_vec();
        Output::Overdue(Waiting { application: "gait".to_owned(), missing, since })
    };
    assert_eq!(bench.passes(Duration::from_secs(59)), []);
    assert_eq!(bench.passes(Duration::from_secs(1)), [waited(60)]);
    assert_eq!(bench.passes(Duration::from_secs(59)), []);
    assert_eq!(bench.passes(Duration::from_secs(1)), [waited(120)]);
}

// spec: SYNC-3
#[test]
fn the_last_known_reason_is_told_for_each_way_to_be_missing() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    let reason = |bench: &Bench| bench.missing().remove(0).1;
    assert_eq!(reason(&bench), "not there");
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("drive", false, &[])]));
    assert_eq!(reason(&bench), "registered, not ready");
    bench.breaks(KNEE);
    assert_eq!(reason(&bench), "its link is down");
    bench.links(KNEE, LIFE);
    assert_eq!(reason(&bench), "its node is linked again, its directory has not come yet");
    bench.list(KNEE, list(2, &[]));
    assert_eq!(reason(&bench), "unregistered");
    bench.list(KNEE, list(3, &[("drive", false, &[])]));
    bench.lost(KNEE, LossReason::LinkDown);
    assert_eq!(reason(&bench), "its node was lost");
    bench.links(KNEE, LIFE);
    bench.hears(Input::LinkChanged(LinkFact::PeerLeft { node: KNEE, incarnation: LIFE, gave_up: None }));
    bench.lost(KNEE, LossReason::LinkDown);
    assert_eq!(reason(&bench), "its node left");
    bench.registers(1, "drive", &[]);
    assert_eq!(reason(&bench), "registered, not ready", "what this node knows comes first");
    bench.down(1);
    assert_eq!(reason(&bench), "failed, not ready again");
}

#[test]
fn a_name_that_nobody_has_is_reported_after_two_seconds_with_those_that_are_similar() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee.sensor", true, &[]), ("hip.drive", true, &[])]));
    bench.registers(1, "knee.drive", &["knee.sensor"]);
    bench.registers(0, "hip", &["knee.senser", "camera | lidar", "arm.*", "knee.drive"]);
    bench.passes(Duration::from_millis(1_999));
    assert_eq!(bench.misspelt, []);
    assert!(bench.missing().contains(&("knee.senser".to_owned(), "not there")));
    assert!(bench.core.next_wake() <= Some(bench.now + Duration::from_millis(1)));
    bench.passes(Duration::from_millis(1));
    let nearest = ["knee.sensor (ready)", "knee.drive (starting)"].map(str::to_owned).to_vec();
    let report = |name: &str, nearest| ("hip".to_owned(), name.to_owned(), nearest);
    let none = Vec::new;
    let all = [report("camera", none()), report("lidar", none()), report("knee.senser", nearest)];
    assert_eq!(bench.misspelt, all);
    let why = "not there; nearest: knee.sensor (ready), knee.drive (starting)";
    let missing = bench.core.waiting(bench.now).remove(0).missing;
    assert!(missing.iter().any(|absence| absence.name == "knee.senser" && absence.why == why), "{missing:?}");
    // Again, but seldom; and no more once somebody has it.
    bench.passes(Duration::from_secs(299));
    assert_eq!(bench.misspelt.len(), 3);
    bench.list(KNEE, list(2, &[("knee.sensor", true, &[]), ("knee.senser", false, &[])]));
    bench.passes(Duration::from_secs(1));
    assert_eq!(bench.misspelt.len(), 5, "the other two");
}

// spec: SYNC-7
#[test]
fn a_cycle_is_refused_with_its_names_whoever_came_first() {
    let mut bench = Bench::new();
    bench.registers(0, "a", &["b"]);
    let cycle = Output::Cycle { names: ["a", "b", "a"].map(str::to_owned).to_vec() };
    assert_eq!(bench.registers(1, "b", &["a"]), [cycle]);
    assert_eq!(bench.registers(2, "c", &[]), [release(2)], "said once; others start");
    assert_eq!(bench.missing(), [("b".to_owned(), "part of a cycle of requirements")]);
    // Without the requirement there is no cycle.
    bench.hears(Input::AppChanged(AppFact::Unregistered { app: app(1) }));
    assert_eq!(bench.registers(1, "b", &[]), [release(1)]);
    assert_eq!(bench.ready(1), [release(0)]);
}

// spec: SYNC-7
#[test]
fn a_cycle_through_two_nodes_is_seen() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.registers(0, "hip", &["knee"]);
    let outputs = bench.list(KNEE, list(1, &[("knee", false, &["hip"])]));
    assert_eq!(outputs, [Output::Cycle { names: ["hip", "knee", "hip"].map(str::to_owned).to_vec() }]);
    assert_eq!(
        bench.list(KNEE, list(2, &[("knee", true, &["hip"])])),
        [],
        "refused, even where it runs by chance"
    );
    assert_eq!(bench.missing(), [("knee".to_owned(), "part of a cycle of requirements")]);
    let names = ["hip", "knee", "hip"].map(str::to_owned);
    assert!(bench.core.has_cycle(&names));
    assert_eq!(bench.list(KNEE, list(3, &[("knee", true, &[])])), [release(0)]);
    assert!(!bench.core.has_cycle(&names));
}

// spec: SYNC-2
#[test]
fn the_whole_list_goes_out_at_link_up_at_each_change_and_every_two_seconds() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    let first = published(&bench.links(KNEE, LIFE));
    assert_eq!(first.len(), 1);
    let Entry { name, ready, requires, .. } = &first[0].entries[0];
    assert_eq!((&**name, *ready, requires.len()), ("gait", false, 1));
    let outputs = bench.registers(1, "drive", &[]);
    assert_eq!(published(&outputs), [], "the least time has not passed");
    let second = published(&bench.passes(SPACING));
    assert_eq!((second.len(), second[0].entries.len()), (1, 2));
    assert!(second[0].version > first[0].version);
    assert_eq!(published(&bench.passes(REPEAT)), second, "unchanged, so with the same version");
    assert_eq!(bench.core.next_wake(), Some(bench.now + REPEAT));
    bench.breaks(KNEE);
    assert_eq!(published(&bench.passes(REPEAT)), []);
}

#[test]
fn one_fixed_address_on_two_nodes_is_two_tids() {
    let mut bench = Bench::new();
    bench.registers(0, "hip.drive", &[]);
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("knee.drive", true, &[])]));
    let tids = bench.core.directory().into_iter().map(|entry| entry.tid);
    assert_eq!(tids.collect::<Vec<_>>(), [Tid::new(HERE, app(0)), Tid::new(KNEE, app(0))]);
}

// spec: SYNC-6
#[test]
fn a_name_belongs_to_this_node_then_to_the_linked_then_to_the_lowest() {
    let mut bench = Bench::new();
    for node in [KNEE, ANKLE] {
        bench.links(node, LIFE);
    }
    bench.list(ANKLE, list(1, &[("imu", true, &[])]));
    let outputs = bench.list(KNEE, list(1, &[("imu", true, &[])]));
    let tids = vec![Tid::new(KNEE, app(0)), Tid::new(ANKLE, app(0))];
    assert_eq!(outputs, [Output::SameName { name: "imu".to_owned(), tids }]);
    assert_eq!(bench.core.called("imu").first().copied(), Some(Tid::new(KNEE, app(0))));
    bench.breaks(KNEE);
    assert_eq!(bench.core.called("imu").first().copied(), Some(Tid::new(ANKLE, app(0))));
    bench.registers(7, "imu", &[]);
    assert_eq!(bench.core.called("imu").first().copied(), Some(Tid::new(HERE, app(7))));
    assert_eq!(bench.core.called("nobody").first().copied(), None);
    bench.hears(Input::AppChanged(AppFact::Unregistered { app: app(7) }));
    bench.lost(ANKLE, LossReason::LinkDown);
    assert_eq!(
        bench.core.called("imu").first().copied(),
        Some(Tid::new(KNEE, app(0))),
        "its link is down, its node is not lost"
    );
}

#[test]
fn groups_of_a_node_are_routed_until_it_is_lost() {
    let mut bench = Bench::new();
    let found = MembershipFact::NodeFound {
        node: KNEE,
        incarnation: LIFE,
        gncl: vec![SocketAddr::from(([127, 0, 0, 2], 1))],
    };
    let groups = vec![AppAddress::group("drives")];
    let route = |groups: &[AppAddress]| Output::RouteGroups { node: KNEE, groups: groups.to_vec() };
    let with_group = |version| List { groups: groups.clone(), ..list(version, &[]) };
    bench.links(KNEE, LIFE);
    assert_eq!(bench.list(KNEE, with_group(1)), [route(&groups)]);
    assert_eq!(bench.breaks(KNEE), []);
    assert_eq!(bench.lost(KNEE, LossReason::LinkDown), [route(&[])]);
    assert_eq!(bench.hears(Input::MembershipChanged(found)), [route(&groups)]);
    let own = Published { groups: groups.clone(), own: 1, ..Published::default() };
    let mine = bench.hears(Input::GroupsChanged(own));
    assert_eq!(published(&mine), [], "not linked");
    bench.now = bench.now + SPACING;
    assert_eq!(published(&bench.links(KNEE, LIFE))[0].groups, groups);
    assert!(bench.links(KNEE, NEXT_LIFE).contains(&route(&[])), "nobody has joined in the new life yet");
}

// spec: SYNC-4
#[test]
fn what_is_not_a_list_is_refused_and_changes_nothing() {
    let mut bench = Bench::new();
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    let before = bench.core.directory();
    let garbage = |from| Input::ListReceived { from, payload: Bytes::from_static(b"\xc1garbage") };
    let own = Input::ListReceived { from: HERE, payload: list(9, &[]).encode(usize::MAX).0 };
    let long = Input::ListReceived { from: KNEE, payload: vec![0; (1 << 20) + 1].into() };
    for input in [garbage(KNEE), garbage(NodeAddress::ALL), own, long] {
        let outputs = bench.hears(input);
        assert!(matches!(outputs[..], [Output::Refused { cause: "directory", .. }]), "{outputs:?}");
    }
    assert_eq!(bench.core.directory(), before);
}

#[test]
fn more_nodes_than_allowed_are_refused_until_one_is_lost() {
    let mut config = NodeConfig::new("hip");
    config.ndl.nodes_max = 1;
    let core = Core::new(&config, HERE, Incarnation(1));
    let mut bench = Bench { core, now: Time::ZERO, misspelt: Vec::new() };
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    assert!(matches!(bench.links(ANKLE, LIFE)[..], [Output::Refused { cause: "nodes", .. }]));
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::LinkDown);
    bench.links(ANKLE, LIFE);
    assert_eq!(bench.list(ANKLE, list(1, &[])), []);
    assert_eq!(bench.core.directory(), []);
}

#[test]
fn an_application_without_a_name_waits_like_any_other_and_is_in_no_list() {
    let mut bench = Bench::new();
    assert_eq!(bench.registers(0, "", &["sensor"]), []);
    assert_eq!(bench.core.waiting(bench.now)[0].application, "1000");
    assert_eq!(bench.core.directory(), []);
    bench.registers(1, "sensor", &[]);
    assert_eq!(bench.ready(1), [release(0)]);
    let outputs = bench.registers(2, "sensor", &[]);
    assert!(
        matches!(outputs[..], [Output::Refused { cause: "name", .. }, Output::Release { .. }]),
        "{outputs:?}"
    );
}
