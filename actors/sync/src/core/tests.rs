//! The rules of the sync manager, one claim per test.

use std::{collections::VecDeque, net::SocketAddr, time::Duration};

mod barrier_fixture;
mod barriers;
mod directory;
mod fixture;
mod forms;
mod incarnations;
mod phases;
mod publish;
mod shares;
mod stalls;

use sinew_model::{
    directory::{Absence, DirectoryEntry},
    facts::LossReason,
};

use self::{
    fixture::{Bench, app, list, lost, met, published, release},
    forms::in_words,
};
use super::{
    own_list::{REPEAT, SPACING},
    retry::RETRY,
    start_barrier::UNREACHABLE_MAX,
    *,
};
use crate::list::{Entry, List, Name};

const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
const KNEE: NodeAddress = NodeAddress::new(0x7f00_0002);
const ANKLE: NodeAddress = NodeAddress::new(0x7f00_0003);
const INCARNATION: Incarnation = Incarnation(5);
const NEXT_INCARNATION: Incarnation = Incarnation(6);

#[test]
fn application_without_requirements_is_released_at_once() {
    assert_eq!(Bench::new().registers(0, "plant", &[]), [release(0)]);
}

// spec: SYNC-5
#[test]
fn application_is_released_when_its_last_requirement_is_ready() {
    let mut bench = Bench::new();
    assert_eq!(bench.registers(0, "gait", &["sensor", "knee.drive"]), []);
    assert_eq!(bench.registers(1, "sensor", &[]), [release(1)]);
    assert_eq!(bench.ready(1), []);
    bench.links(KNEE, INCARNATION);
    assert_eq!(bench.list(KNEE, list(1, &[("knee.drive", false, &[])])), []);
    assert_eq!(bench.list(KNEE, list(2, &[("knee.drive", true, &[])])), [release(0)]);
}

// spec: SYNC-5
#[test]
fn failed_application_waits_again_and_others_are_only_notified() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    assert_eq!(bench.down(1), [lost(0, "sensor", Reason::Failed), release(1)]);
    assert_eq!(bench.ready(1), [met(0, "sensor")]);
    assert_eq!(bench.down(0), [release(0)], "all that it requires is ready still");
    assert_eq!(bench.registers(0, "gait", &["sensor"]), [], "registered again");
    bench.down(1);
    assert_eq!(bench.registers(0, "gait", &["sensor", "sensor.left"]), [], "other requirements: a new life");
    bench.ready(1);
    bench.registers(2, "sensor.left", &[]);
    assert_eq!(bench.ready(2), [release(0)]);
}

// spec: SYNC-8
#[test]
fn running_application_is_notified_of_loss_and_return() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(3, &[("knee.drive", true, &[])]));
    bench.registers(0, "gait", &["knee.drive"]);
    bench.ready(0);
    assert_eq!(bench.lost(KNEE, LossReason::LinkDown), [lost(0, "knee.drive", Reason::NodeLost)]);
    assert_eq!(bench.breaks(KNEE), []);
    let back = bench.links(KNEE, NEXT_INCARNATION);
    assert!(!back.contains(&met(0, "knee.drive")), "a link alone says nothing about the application");
    let mut restarted = list(1, &[("knee.drive", true, &[])]);
    restarted.incarnation = NEXT_INCARNATION;
    assert_eq!(bench.list(KNEE, restarted), [met(0, "knee.drive")]);
}

/// Application 0 is "gait", runs, and requires "knee.drive", which is ready on the node of the knee.
fn where_gait_runs_with_a_drive_elsewhere() -> Bench {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(3, &[("knee.drive", true, &[])]));
    bench.registers(0, "gait", &["knee.drive"]);
    bench.ready(0);
    bench
}

// spec: SYNC-8
#[test]
fn restarted_layer_causes_no_loss_report() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    assert_eq!(bench.breaks(KNEE), []);
    assert_eq!(bench.passes(UNREACHABLE_MAX / 3), []);
    assert_eq!(published(&bench.links(KNEE, INCARNATION)).len(), 1);
    assert_eq!(bench.passes(UNREACHABLE_MAX / 3), [], "its list has not come yet");
    assert_eq!(bench.list(KNEE, list(3, &[("knee.drive", true, &[])])), []);
    let events: Vec<_> =
        bench.passes(REPEAT).into_iter().filter(|out| matches!(out, Output::Notify { .. })).collect();
    assert_eq!(events, []);
}

// spec: SYNC-8
#[test]
fn lasting_link_break_is_a_loss() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    assert_eq!(bench.core.next_wake(), Some(bench.now + UNREACHABLE_MAX));
    assert_eq!(bench.passes(UNREACHABLE_MAX), [lost(0, "knee.drive", Reason::LinkDown)]);
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    assert_eq!(bench.lost(KNEE, LossReason::Crashed), [lost(0, "knee.drive", Reason::NodeLost)]);
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    bench.links(KNEE, INCARNATION);
    assert_eq!(
        bench.list(KNEE, list(4, &[("knee.drive", false, &[])])),
        [lost(0, "knee.drive", Reason::NotReady)]
    );
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    bench.breaks(KNEE);
    assert!(bench.links(KNEE, NEXT_INCARNATION).contains(&lost(0, "knee.drive", Reason::NodeRestarted)));
}

// spec: SYNC-8
#[test]
fn orderly_stop_is_not_reported_as_failure() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    let stopped = bench.handle(Input::AppChanged(AppFact::Stopped { app: app(1) }));
    assert_eq!(stopped, [lost(0, "sensor", Reason::Stopped), release(1)]);
    assert!(Reason::Stopped.is_orderly() && !Reason::Failed.is_orderly());
    assert_eq!(
        in_words(bench.core.missing(bench.now, app(0))),
        [("sensor".to_owned(), "stopped in order, not ready again")]
    );
}

// spec: SYNC-8
#[test]
fn next_life_is_notified_of_a_met_requirement() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    bench.down(1);
    assert_eq!(bench.down(0), []);
    assert_eq!(bench.ready(1), [release(0), met(0, "sensor")]);
    assert_eq!(bench.ready(0), []);
}

// spec: SYNC-8
#[test]
fn loss_before_the_next_life_is_reported_to_it() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    bench.down(1);
    bench.down(0);
    assert_eq!(bench.ready(1), [release(0), met(0, "sensor")]);
    assert_eq!(bench.down(1), [lost(0, "sensor", Reason::Failed), release(1)]);
}

// spec: SYNC-8
#[test]
fn rejected_event_is_retried_in_its_latest_form() {
    let mut bench = Bench::where_gait_runs_with_its_sensor();
    bench.down(1);
    let name = || "sensor".to_owned();
    assert_eq!(bench.handle(Input::EventRejected { app: app(0), name: name() }), []);
    assert_eq!(bench.handle(Input::RoomMade), [lost(0, "sensor", Reason::Failed)]);
    bench.handle(Input::EventRejected { app: app(0), name: name() });
    assert_eq!(bench.ready(1), [met(0, "sensor")]);
    assert_eq!(bench.handle(Input::RoomMade), [], "the lost one is out of date");
    bench.handle(Input::ReleaseRejected { app: app(2) });
    bench.registers(2, "late", &[]);
    bench.handle(Input::ReleaseRejected { app: app(2) });
    assert_eq!(bench.passes(RETRY), [release(2)]);
}

// spec: SYNC-9
// spec: SYNC-5
#[test]
fn rejected_release_is_repeated_only_if_still_met() {
    let given = || {
        let mut bench = Bench::new();
        bench.registers(0, "sensor", &[]);
        bench.registers(1, "gait", &["sensor"]);
        assert!(bench.ready(0).contains(&release(1)));
        bench.handle(Input::ReleaseRejected { app: app(1) });
        bench.down(0);
        let again = bench.passes(RETRY);
        assert!(!again.contains(&release(1)), "{again:?}");
        bench
    };
    let mut bench = given();
    assert!(bench.ready(0).contains(&release(1)));
    assert_eq!(bench.ready(1), [], "nothing has changed for it");
    // The application may have received the release and started: then it is notified of the loss.
    let mut bench = given();
    assert_eq!(bench.ready(1), [lost(1, "sensor", Reason::Failed)]);
    assert!(bench.ready(0).contains(&met(1, "sensor")));
}

#[test]
fn each_passed_deadline_reports_missing_names_times_and_reasons() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["sensor", "knee.drive"]);
    bench.registers(1, "sensor", &[]);
    let deadline = bench.core.next_wake().unwrap();
    assert_eq!(
        deadline,
        bench.now + Duration::from_secs(2),
        "the first deadline is the check for misspelt names"
    );
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
fn lost_required_name_is_missing_with_its_reason() {
    let mut bench = where_gait_runs_with_a_drive_elsewhere();
    assert_eq!(bench.core.why_required_is_missing(bench.now, "knee.drive"), None);
    bench.lost(KNEE, LossReason::Crashed);
    bench.passes(Duration::from_secs(2));
    let why = bench.core.why_required_is_missing(bench.now, "knee.drive").expect("gait requires it");
    assert!(why.starts_with("its node was lost ("), "{why}");
    // Another name, and one that no application ever had, are explained by similar names.
    bench.registers(2, "arm", &["elbow"]);
    for name in ["camera", "elbow"] {
        assert_eq!(bench.core.why_required_is_missing(bench.now, name), None);
    }
}

#[test]
fn last_known_reason_is_reported_for_each_absence() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    let reason = |bench: &Bench| bench.missing().remove(0).1;
    assert_eq!(reason(&bench), "not there");
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("drive", false, &[])]));
    assert_eq!(reason(&bench), "registered, not ready");
    bench.breaks(KNEE);
    assert_eq!(reason(&bench), "its link is down");
    bench.links(KNEE, INCARNATION);
    assert_eq!(reason(&bench), "its node is linked again, its directory has not come yet");
    bench.list(KNEE, list(2, &[]));
    assert_eq!(reason(&bench), "unregistered");
    bench.list(KNEE, list(3, &[("drive", false, &[])]));
    bench.lost(KNEE, LossReason::LinkDown);
    assert_eq!(reason(&bench), "its node was lost");
    bench.links(KNEE, INCARNATION);
    bench.handle(Input::LinkChanged(LinkFact::PeerLeft {
        node: KNEE,
        incarnation: INCARNATION,
        gave_up: None,
    }));
    bench.lost(KNEE, LossReason::LinkDown);
    assert_eq!(reason(&bench), "its node left");
    bench.registers(1, "drive", &[]);
    assert_eq!(reason(&bench), "registered, not ready", "the state on this node has precedence");
    bench.down(1);
    assert_eq!(reason(&bench), "failed, not ready again");
}

#[test]
fn unknown_name_is_reported_with_similar_ones() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
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
    // Again, but seldom; and no more once an application has the name.
    bench.passes(Duration::from_secs(299));
    assert_eq!(bench.misspelt.len(), 3);
    bench.list(KNEE, list(2, &[("knee.sensor", true, &[]), ("knee.senser", false, &[])]));
    bench.passes(Duration::from_secs(1));
    assert_eq!(bench.misspelt.len(), 5, "the other two");
}

// spec: SYNC-7
#[test]
fn cycle_is_refused_in_any_order_of_arrival() {
    let mut bench = Bench::new();
    bench.registers(0, "a", &["b"]);
    let cycle = Output::Cycle { names: ["a", "b", "a"].map(str::to_owned).to_vec() };
    assert_eq!(bench.registers(1, "b", &["a"]), [cycle]);
    assert_eq!(bench.registers(2, "c", &[]), [release(2)], "reported once; others start");
    assert_eq!(bench.missing(), [("b".to_owned(), "part of a cycle of requirements")]);
    // Without the requirement there is no cycle.
    bench.handle(Input::AppChanged(AppFact::Unregistered { app: app(1) }));
    assert_eq!(bench.registers(1, "b", &[]), [release(1)]);
    assert_eq!(bench.ready(1), [release(0)]);
}

// spec: SYNC-7
#[test]
fn cycle_through_two_nodes_is_detected() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
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
fn full_list_is_sent_at_changes_and_periodically() {
    let mut bench = Bench::new();
    bench.registers(0, "gait", &["drive"]);
    let first = published(&bench.links(KNEE, INCARNATION));
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
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("knee.drive", true, &[])]));
    let tids = bench.core.directory().into_iter().map(|entry| entry.tid);
    assert_eq!(tids.collect::<Vec<_>>(), [Tid::new(HERE, app(0)), Tid::new(KNEE, app(0))]);
}

// spec: SYNC-6
#[test]
fn name_resolves_by_own_then_linked_then_lowest() {
    let mut bench = Bench::new();
    for node in [KNEE, ANKLE] {
        bench.links(node, INCARNATION);
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
    bench.handle(Input::AppChanged(AppFact::Unregistered { app: app(7) }));
    bench.lost(ANKLE, LossReason::LinkDown);
    assert_eq!(
        bench.core.called("imu").first().copied(),
        Some(Tid::new(KNEE, app(0))),
        "its link is down, its node is not lost"
    );
}

#[test]
fn groups_are_routed_until_the_node_is_lost() {
    let mut bench = Bench::new();
    let found = MembershipFact::NodeFound {
        node: KNEE,
        incarnation: INCARNATION,
        gncl: vec![SocketAddr::from(([127, 0, 0, 2], 1))],
    };
    let groups = vec![AppAddress::group("drives")];
    let route = |groups: &[AppAddress]| Output::RouteGroups { node: KNEE, groups: groups.to_vec() };
    let with_group = |version| List { groups: groups.clone(), ..list(version, &[]) };
    bench.links(KNEE, INCARNATION);
    assert_eq!(bench.list(KNEE, with_group(1)), [route(&groups)]);
    assert_eq!(bench.breaks(KNEE), []);
    assert_eq!(bench.lost(KNEE, LossReason::LinkDown), [route(&[])]);
    assert_eq!(bench.handle(Input::MembershipChanged(found)), [route(&groups)]);
    let own = Published { groups: groups.clone(), own: 1, ..Published::default() };
    let mine = bench.handle(Input::GroupsChanged(own));
    assert_eq!(published(&mine), [], "not linked");
    bench.now = bench.now + SPACING;
    assert_eq!(published(&bench.links(KNEE, INCARNATION))[0].groups, groups);
    assert!(
        bench.links(KNEE, NEXT_INCARNATION).contains(&route(&[])),
        "no application of the new incarnation has joined yet"
    );
}

// spec: SYNC-4
#[test]
fn invalid_list_is_rejected_and_changes_nothing() {
    let mut bench = Bench::new();
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    let before = bench.core.directory();
    let garbage = |from| Input::ListReceived { from, payload: Bytes::from_static(b"\xc1garbage") };
    let own = Input::ListReceived { from: HERE, payload: list(9, &[]).encode(usize::MAX).0 };
    let long = Input::ListReceived { from: KNEE, payload: vec![0; (1 << 20) + 1].into() };
    for input in [garbage(KNEE), garbage(NodeAddress::ALL), own, long] {
        let outputs = bench.handle(input);
        assert!(matches!(outputs[..], [Output::Refused { cause: "directory", .. }]), "{outputs:?}");
    }
    assert_eq!(bench.core.directory(), before);
}

#[test]
fn nodes_beyond_the_limit_are_rejected() {
    let mut config = NodeConfig::new("hip");
    config.ndl.nodes_max = 1;
    let core = Core::new(&config, HERE, Incarnation(1));
    let mut bench = Bench { core, now: Time::ZERO, misspelt: Vec::new() };
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(1, &[("drive", true, &[])]));
    assert!(matches!(bench.links(ANKLE, INCARNATION)[..], [Output::Refused { cause: "nodes", .. }]));
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::LinkDown);
    bench.links(ANKLE, INCARNATION);
    assert_eq!(bench.list(ANKLE, list(1, &[])), []);
    assert_eq!(bench.core.directory(), []);
}

#[test]
fn unnamed_application_waits_too_and_is_in_no_list() {
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
