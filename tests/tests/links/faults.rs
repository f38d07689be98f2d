//! Faults of the link between two nodes under load, in short: the long form is the program `link_faults`.

use std::time::Duration;

use sinew_tests::link_faults::{Plan, Report, Trouble, run};

/// Runs the faults at 3,000 messages a second.
fn report(troubles: &[Trouble], faults: u64) -> Report {
    plan(troubles, faults, |_| {})
}

fn plan(troubles: &[Trouble], faults: u64, change: impl FnOnce(&mut Plan)) -> Report {
    let mut plan = Plan {
        rate: 3_000,
        back_rate: 300,
        filling: 128,
        troubles: troubles.to_vec(),
        faults,
        spacing: Duration::from_millis(40),
        hold: Duration::from_millis(500),
        one_flip_in: None,
        seed: u64::from(std::process::id()),
    };
    change(&mut plan);
    let report = run(&plan);
    println!("{report}");
    report
}

#[test]
fn cuts_and_gncl_panics_lose_and_reorder_nothing() {
    let troubles = [Trouble::Cut, Trouble::PanicSender, Trouble::Finish, Trouble::PanicReceiver];
    let report = report(&troubles, 40);
    assert!(report.holds() && report.verdict.is_perfect(), "{report}");
    assert!(report.verdict.asked > 0 && report.network.cut > 0, "{report}");
    agrees(&report);
}

/// Without a lost node, the counters of the nodes agree with the recorded history.
#[track_caller]
fn agrees(report: &Report) {
    let total = report.audit.total();
    // A value is resent by the connection if the acknowledgement of its datagram does not arrive. It counts
    // as two values, of which one is superseded.
    assert!(total.superseded >= report.verdict.superseded, "{report}");
    assert_eq!((total.expired, total.failed, total.lost, total.unknown), (0, 0, 0, 0), "{report}");
    for link in &report.audit.links {
        // The audit's own request and reply may lie between the readings.
        let taken = link.taken.expect("both ends speak of one session");
        assert!(link.sent.abs_diff(taken) <= 1, "{link}\n{report}");
    }
}

#[test]
fn flipped_bits_cost_connections_and_no_message() {
    let report = plan(&[Trouble::Cut], 5, |plan| {
        plan.one_flip_in = Some(40_000);
        plan.spacing = Duration::from_millis(400);
    });
    assert!(report.holds() && report.verdict.is_perfect(), "{report}");
    assert!(report.network.flips > 0, "{report}");
    agrees(&report);
}

#[test]
fn link_stalled_for_less_than_a_loss_loses_nothing() {
    let report = report(&[Trouble::Stall, Trouble::PartThere, Trouble::PartBack], 3);
    assert!(report.verdict.is_perfect(), "{report}");
    agrees(&report);
}

#[test]
fn confirmed_messages_of_a_killed_node_have_outcomes() {
    let report = report(&[Trouble::KillReceiver, Trouble::KillSender], 4);
    assert!(report.holds(), "{report}");
    assert!(report.verdict.got > 0 && report.verdict.asked > 0, "{report}");
}

#[test]
fn wall_clock_jumps_affect_no_message() {
    if std::process::Command::new("cc").arg("--version").output().is_err() {
        println!("skipped: there is no cc on this machine, which a clock that is set needs");
        return;
    }
    let report = report(&[Trouble::ClockOn, Trouble::ClockBack, Trouble::ClockBack, Trouble::Cut], 12);
    assert!(report.holds() && report.verdict.is_perfect(), "{report}");
    agrees(&report);
}
