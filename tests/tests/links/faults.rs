//! Faults of the link between two nodes under load, in short: the long form is the program `link_faults`.

use std::time::Duration;

use sinew_tests::{
    link_faults::{Plan, Report, Trouble, run},
    program,
};

/// What happens at 3,000 messages a second.
fn report(troubles: &[Trouble], faults: u64) -> Report {
    plan(troubles, faults, |_| {})
}

fn plan(troubles: &[Trouble], faults: u64, change: impl FnOnce(&mut Plan)) -> Report {
    let mut plan = Plan {
        program: program("link_faults"),
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
fn cuts_and_panics_of_gncl_on_both_sides_lose_double_and_reorder_nothing() {
    let troubles = [Trouble::Cut, Trouble::PanicSender, Trouble::Finish, Trouble::PanicReceiver];
    let report = report(&troubles, 40);
    assert!(report.holds() && report.verdict.is_perfect(), "{report}");
    assert!(report.verdict.asked > 0 && report.network.cut > 0, "{report}");
    agrees(&report);
}

/// Where no node was lost, what the nodes say of the messages is what the history says.
#[track_caller]
fn agrees(report: &Report) {
    let total = report.audit.total();
    // A value that goes by the connection after all, as no word came that it had arrived by datagram, counts as two, of which one is superseded.
    assert!(total.superseded >= report.verdict.superseded, "{report}");
    assert_eq!((total.expired, total.failed, total.lost, total.unknown), (0, 0, 0, 0), "{report}");
    for link in &report.audit.links {
        // The audit's own question and answer may lie between the readings.
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
fn a_link_that_is_stalled_or_parted_for_less_than_a_loss_takes_loses_nothing() {
    let report = report(&[Trouble::Stall, Trouble::PartThere, Trouble::PartBack], 3);
    assert!(report.verdict.is_perfect(), "{report}");
    agrees(&report);
}

#[test]
fn of_a_killed_node_every_confirmed_message_has_its_outcome() {
    let report = report(&[Trouble::KillReceiver, Trouble::KillSender], 4);
    assert!(report.holds(), "{report}");
    assert!(report.verdict.got > 0 && report.verdict.asked > 0, "{report}");
}

#[test]
fn wall_clocks_that_jump_by_a_day_are_noticed_by_no_message() {
    if std::process::Command::new("cc").arg("--version").output().is_err() {
        println!("skipped: there is no cc on this machine, which a clock that is set needs");
        return;
    }
    let report = report(&[Trouble::ClockOn, Trouble::ClockBack, Trouble::ClockBack, Trouble::Cut], 12);
    assert!(report.holds() && report.verdict.is_perfect(), "{report}");
    agrees(&report);
}
