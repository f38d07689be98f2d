//! Protected messages that their receiver does not guard.

use super::*;

const GUARDED: Tid = Tid::new(NodeAddress::new(0x0a00_0001), AppAddress::new(0x1001));
const WHAT: &str = "knee.drive guards gait";

/// The gait on the hip at this address; the drive of the knee has refused its torques.
fn refused(gait: AppAddress, ago_us: u64) -> Facts {
    let mut facts = free();
    let sender = Tid::new(node(1), gait);
    facts.ends[0].wanted = "gait".to_owned();
    let mut gait = app("gait");
    gait.report.as_mut().expect("it is listed").tid = sender;
    facts.ends[0].app = Some(gait);
    let receiver = drive(&mut facts).report.as_ref().expect("it is listed").tid;
    let kind = sinew::message::Kind::named("demo.torque");
    let kind_name = Some("demo.torque".to_owned());
    let unguarded = UnguardedReport { receiver, sender, kind, kind_name, count: 50, ago_us };
    knee(&mut facts).unguarded.push(unguarded);
    facts
}

fn lost_echo(facts: &mut Facts) {
    let receiver = drive(facts).report.as_ref().expect("it is listed").tid;
    let why = "NoSuchApplication".to_owned();
    knee(facts).lost_echoes.push(LostEchoReport { receiver, guarded: GUARDED, why, count: 3, ago_us: 1_000 });
}

fn step(facts: &Facts) -> Step {
    judge(facts).into_iter().find(|step| step.what == WHAT).expect("it is judged")
}

#[test]
fn sender_at_an_unguarded_address_blocks_with_both_addresses() {
    let mut facts = refused(AppAddress::new(0x8000_0000), 1_000);
    lost_echo(&mut facts);
    let blocked = step(&facts);
    assert_eq!(blocked.state, State::Blocked, "{blocked:?}");
    let detail =
        "knee.drive guards messages of 10.0.0.1/1001; gait is 10.0.0.1/80000000: 50 messages of demo.torque";
    assert!(blocked.detail.starts_with(detail), "{blocked:?}");
    let fix = "give gait `.address(AppAddress::new(0x1001))`, or have knee.drive guard for its address";
    assert_eq!(blocked.fix.as_deref(), Some(fix));
    // An echo of a previous guard is no evidence of the current one.
    knee(&mut facts).lost_echoes[0].ago_us = RECENT_US;
    assert!(step(&facts).detail.starts_with("knee.drive guards no demo.torque"));
}

#[test]
fn unguarded_sender_blocks_with_its_address() {
    let blocked = step(&refused(AppAddress::new(0x8000_0000), 1_000));
    assert_eq!(blocked.state, State::Blocked, "{blocked:?}");
    assert!(
        blocked.detail.starts_with("knee.drive guards no demo.torque of gait, which is 10.0.0.1/80000000"),
        "{blocked:?}"
    );
    assert!(blocked.fix.is_some_and(|fix| fix.contains("`.address(..)`")));
    // A sender with a fixed address needs no other address.
    let fixed = step(&refused(AppAddress::new(0x1001), 1_000));
    assert_eq!(fixed.fix.as_deref(), Some("have knee.drive guard for 10.0.0.1/1001 (`ctx.guard`)"));
}

#[test]
fn only_recent_refusals_of_the_sender_block() {
    assert_eq!(step(&refused(AppAddress::new(0x1001), RECENT_US)).state, State::Note);
    let mut facts = refused(AppAddress::new(0x1001), 1_000);
    knee(&mut facts).unguarded[0].sender = Tid::new(node(3), AppAddress::new(0x1001));
    assert!(judge(&facts).iter().all(|step| step.what != WHAT && step.state != State::Blocked));
}
