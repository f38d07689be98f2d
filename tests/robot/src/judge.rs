//! Compares the injections with the observations: the claims of each step.

use std::collections::BTreeSet;

use exoskeleton::robot::trace::{DriveRow, GaitRow, PlantRow};
use exoskeleton_model::central::bit;
use exoskeleton_model::control::faults::FaultBits;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode};
use exoskeleton_model::part::Part;
use exoskeleton_recording::flight::SpanFile;
use sinew::{Time, events::LossReason};
use sinew_bag::check::{Finding, Kind};

use crate::claim::{Claim, Claims, REPORTED};
use crate::evidence::{Evidence, Loss, SAFE_AT_LATEST_NS, Span, ms_after, span};
use crate::script::{Injection, Mark, Seen};
use crate::step::Step;

/// By class of machine, ms: loss detected.
const LOST_MS: [f64; 3] = [10.0, 20.0, 200.0];
/// Loss detected, and all drives safe.
const SAFE_MS: [f64; 3] = [15.0, 30.0, 250.0];
/// The drive's device damps by itself.
const DAMPED_MS: [f64; 3] = [10.0, 20.0, 100.0];
/// From the death of a drive to the first valid output of the next.
const RESTART_MS: [f64; 3] = [100.0, 200.0, 1000.0];
/// From the start of a hang to the first valid output of the next drive: the node waits a second for signs of
/// life.
const REPLACED_MS: [f64; 3] = [1500.0, 1700.0, 3000.0];
/// Maximum deviation of a joint with a drive that was away for a moment.
const DEVIATION_DEG: [f64; 3] = [10.0; 3];
/// Assistance of a drive that alone was away rises in 200 ms.
const REJOIN_MIN_MS: f64 = 199.9;
/// A drive that is not affected keeps assisting. On an overloaded host it damps now and then, as it must.
const ASSISTED_MIN_PERCENT: f64 = 50.0;
/// A drive that is away for longer is flagged: 25 ms of silence, a status, a tick, and the delays of a busy
/// host, ms.
const FLAGGED_AFTER_MS: f64 = 50.0;
const SOON_NS: u64 = 300_000_000;
/// Oldest input that may be used, us.
const AGE_MAX_US: u32 = 10_000;
/// A part is back and ready, seconds.
const REJOIN_S: [f64; 3] = [1.0, 2.0, 5.0];
const STOP_HEARD_MS: [f64; 3] = [10.0, 20.0, 100.0];
/// The e-stop was received, and 50 ms later there is no torque.
const STOPPED_MS: [f64; 3] = [60.0, 70.0, 150.0];
/// Walking as before, seconds after assistance began to rise.
const AS_BEFORE_S: [f64; 3] = [5.0; 3];
/// "As before": RMS of a stride, degrees more than before the fault.
const AS_BEFORE_DEG: f64 = 2.0;
const TORQUE_RATE_NM_S: f64 = 2000.0;
/// Step of a device with a lag of 5 ms, in a millisecond, for a torque that moves at the limit, and for two
/// late ticks.
const DEVICE_STEP_NM: f64 = 4.0;
/// Assistance rises in 500 ms, except for rounding; a late tick makes it slower, never quicker.
const RAMP_MIN_MS: f64 = 499.9;
const STRIKES_MIN: f64 = 3.0;
const STOPPED_BELOW_NM: f64 = 0.1;
/// From a moment that the operator sees to the last message that is still in flight, ns.
const SETTLED_NS: u64 = 50_000_000;
/// From an e-stop that all drives have received to torques that are exactly zero, ns.
const STOPPED_NS: u64 = 200_000_000;
/// Allowed growth of the leg's deviation from the person on a rough network, degrees.
const ROUGH_GROWS_DEG: f64 = 0.3;
/// Difference of the span between two nodes of one host: the error of their clocks, and a busy host.
const SPANS_APART_MS: f64 = 50.0;
/// From the last record of a killed node to its death, ms: it sends each millisecond.
const LAST_RECORD_MS: f64 = 100.0;
/// A stride and a bit, ns.
const STRIDE_NS: u64 = 1_400_000_000;

/// Adds the claims of one injection; `failure` is the reason why the robot did not recover from it.
pub(crate) fn judge(evidence: &Evidence, injection: &Injection, failure: Option<&str>, out: &mut Vec<Claim>) {
    let label = label(evidence, injection);
    let mut claims = Claims::new(injection.step, &label, out);
    match injection.step {
        Step::KillDrive | Step::HangDrive => drive_away(&mut claims, evidence, injection),
        Step::PullNode => pull_node(&mut claims, evidence, injection),
        Step::ReturnNode => return_node(&mut claims, evidence, injection),
        Step::EmergencyStop => emergency_stop(&mut claims, evidence, injection),
        Step::InsaneCommands => insane_commands(&mut claims, evidence, injection),
        Step::KillCentral => kill_central(&mut claims, evidence, injection),
        Step::CutLink => cut_link(&mut claims, evidence, injection),
        Step::JoinLink => join_link(&mut claims, evidence, injection),
        Step::RoughNetwork => rough_network(&mut claims, evidence, injection),
    }
    let whole = span(injection.at, injection.until);
    claims.exactly("samples with a torque above the limit", 0, evidence.above_limit(&whole));
    claims.exactly("samples with a torque that is no number", 0, evidence.not_finite(&whole));
    let rate = evidence.torque_rate_max_nm_s(&whole);
    claims.at_most("fastest change of a torque, Nm/s", TORQUE_RATE_NM_S, rate);
    claims.at_most("step of a device within 1 ms, Nm", DEVICE_STEP_NM, evidence.device_step_max_nm(whole));
    claims.is_so("the robot gets over it", failure.is_none());
}

fn label(evidence: &Evidence, injection: &Injection) -> String {
    let phase = evidence.phase_at(injection.at).map(|phase| format!("phase {phase:.2}"));
    let label = (!injection.label.is_empty()).then(|| injection.label.clone());
    label.into_iter().chain(phase).collect::<Vec<_>>().join(", ")
}

/// The maximum of these, if there is one of each.
fn all(values: impl IntoIterator<Item = Option<f64>>) -> Option<f64> {
    values.into_iter().try_fold(0.0, |greatest: f64, value| Some(greatest.max(value?)))
}

/// The moment this many milliseconds after another.
fn later(from: Time, ms: Option<f64>) -> Time {
    Time::from_nanos(from.as_nanos() + (ms.unwrap_or(0.0) * 1e6) as u64)
}

/// The knee's drive is away and returns: the others walk on.
fn drive_away(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let (at, whole) = (injection.at, span(injection.at, injection.until));
    let others = [Joint::Hip, Joint::Ankle];
    let damped = evidence.watchdog_after_ms(Joint::Knee, whole.clone());
    claims.timing("its device damps by itself after, ms", DAMPED_MS, damped);
    claims.exactly(
        "samples with more than b*qd + 1 Nm",
        0,
        evidence.undamped_device(Joint::Knee, whole.clone()),
    );
    let flagged = evidence.gait(whole.clone()).iter().find(|row| row.degraded & bit(Joint::Knee) != 0);
    claims.info("central flags the knee as degraded after, ms", flagged.map(|row| ms_after(at, row.t_ns)));
    let back = injection.when(Mark::Continued).map_or(whole.start, Time::as_nanos)..whole.end;
    let away_ms = evidence.output_after_ms(Joint::Knee, back.clone()).map(|ms| ms + ms_after(at, back.start));
    // The end of a process is reported at once; a hang that ends before central detects it is not reported.
    let is_told = injection.step == Step::KillDrive && !evidence.stalled_around(at.as_nanos());
    let is_news = is_told || away_ms.is_none_or(|ms| ms > FLAGGED_AFTER_MS);
    claims.is_so("the knee is flagged, if it died or was away for 50 ms", flagged.is_some() || !is_news);
    let not_the_knee =
        |row: &&GaitRow| row.degraded & !bit(Joint::Knee) != 0 && !evidence.stalled_around(row.t_ns);
    let others_flagged = evidence.gait(whole.clone()).iter().filter(not_the_knee).count();
    claims.exactly("ticks with a flag for hip or ankle", 0, others_flagged);
    let soon = whole.start..whole.start + SOON_NS;
    let share = evidence.share_in_percent(DriveState::Walk, &others, &soon);
    claims.at_least("time that hip and ankle assist in the next 300 ms, %", ASSISTED_MIN_PERCENT, share);
    let unexplained = evidence.unexplained_safe(&others, &whole);
    claims.timing(
        "SAFE of hip or ankle without a stall of the host",
        [0.0, 0.0, REPORTED],
        Some(unexplained as f64),
    );
    let as_long = whole.start - (whole.end - whole.start)..whole.start;
    let extra = evidence.misses(&others, &whole) as f64 - evidence.misses(&others, &as_long) as f64;
    claims.info("their ticks > 2 ms late, more than in as long before", Some(extra));
    came_back(claims, evidence, injection);
    let deviation = evidence.deviation_max_deg(Joint::Knee, whole);
    if injection.step == Step::HangDrive && injection.when(Mark::Continued).is_none() {
        // Away for more than a second: a weak leg without help, for which no limit is known.
        claims.info("greatest deviation of the knee, deg", deviation);
    } else {
        claims.timing("greatest deviation of the knee, deg", DEVIATION_DEG, deviation);
    }
}

/// The drive, in the same incarnation or a new one: valid output, nothing stale, a ramp.
fn came_back(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let whole = span(injection.at, injection.until);
    let back = injection.when(Mark::Continued).map_or(whole.start, Time::as_nanos)..whole.end;
    let incarnations = evidence.incarnations_begun(&whole);
    match (injection.step, injection.when(Mark::Continued)) {
        (Step::KillDrive, _) => claims.exactly("drives started anew", 1, incarnations),
        (_, Some(_)) => claims.info("drives started anew", Some(incarnations as f64)),
        (_, None) => claims.exactly("drives started anew by their node", 1, incarnations),
    }
    let output = evidence.output_after_ms(Joint::Knee, back.clone());
    match (injection.step, injection.when(Mark::Continued)) {
        (Step::KillDrive, _) => claims.timing("first valid output after, ms", RESTART_MS, output),
        (_, Some(_)) => claims.timing("first valid output after SIGCONT, ms", RESTART_MS, output),
        (_, None) => claims.timing("first valid output of the next after, ms", REPLACED_MS, output),
    }
    let is_stale = |row: &&DriveRow| {
        let age_us = row.sample_age_us.max(row.gait_age_us);
        row.state == DriveState::Walk && age_us.is_none_or(|age_us| age_us > AGE_MAX_US)
    };
    let stale = evidence.drive(Joint::Knee, back.clone()).filter(is_stale).count();
    claims.exactly("torques from stale inputs", 0, stale);
    claims.at_least(
        "assistance rises from none to full in, ms",
        REJOIN_MIN_MS,
        evidence.ramp_ms(&[Joint::Knee], &back),
    );
}

fn pull_node(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let knee = Part::Joint(Joint::Knee);
    let away = span(injection.at, injection.until);
    let others = [Joint::Hip, Joint::Ankle];
    let known_ms = loss_of(claims, evidence, (knee, LossReason::Crashed), &others, &away);
    let damped = evidence.watchdog_after_ms(Joint::Knee, away.clone());
    claims.timing("the knee's device damps by itself after, ms", LOST_MS, damped);
    stay_safe(claims, evidence, &others, (&away, known_ms));
    claims.exactly("samples with more than that, knee", 0, evidence.undamped_device(Joint::Knee, away));
    is_frozen(claims, evidence, injection.at, knee);
}

/// All nodes have the same span around the death of one, which has its last moments.
fn is_frozen(claims: &mut Claims<'_>, evidence: &Evidence, at: Time, dead: Part) {
    let span = evidence.frozen_around(at);
    let files = span.map_or(&[][..], |span| span.files.as_slice());
    let nodes: BTreeSet<&str> = files.iter().map(|file| file.node.as_str()).collect();
    claims.exactly("nodes with a frozen file around it", Part::ALL.len(), nodes.len());
    let apart_ns = span.map(|span| {
        let apart = |file: &SpanFile| (file.begin_ns - span.begin_ns).max(span.end_ns - file.end_ns);
        files.iter().map(apart).max().unwrap_or(0)
    });
    claims.at_most("difference of their spans, ms", SPANS_APART_MS, apart_ns.map(|ns| ns as f64 * 1e-6));
    let paths: Vec<_> = files.iter().map(|file| &file.path).collect();
    let report = sinew_bag::check(&paths).ok().filter(|report| report.files.len() >= Part::ALL.len());
    let findings = |is_of_ends: bool| {
        let of_ends = |finding: &&Finding| matches!(finding.kind, Kind::Lost | Kind::Unsent) == is_of_ends;
        report.as_ref().map(|report| report.findings.iter().filter(of_ends).count() as f64)
    };
    claims.at_most("findings of `sinew bag check` in a file", 0.0, findings(false));
    // A message that is sent at the end of the span arrives behind it.
    claims.info("its findings between two files, as at the edges", findings(true));
    let last = files.iter().find(|file| file.has_died && file.node == dead.name());
    claims.at_most(
        "from its last record to its death, ms",
        LAST_RECORD_MS,
        last.map(|file| -ms_after(at, file.last_ns)),
    );
}

/// A node is lost: the nodes that detect it, their reasons, and the drives that damp. Returns the
/// milliseconds until all knew.
fn loss_of(
    claims: &mut Claims<'_>,
    evidence: &Evidence,
    (lost, why): (Part, LossReason),
    drives: &[Joint],
    away: &Span,
) -> Option<f64> {
    let peers = Part::ALL.into_iter().filter(|part| *part != lost);
    let losses: Vec<_> = peers.map(|part| evidence.node_lost(part, lost, away.clone())).collect();
    let known_ms = noticed(claims, "NODE_LOST at every other node after, ms", why, &losses);
    let from = Time::from_nanos(away.start);
    let safe = all(drives.iter().map(|joint| evidence.safe_after_ms(*joint, from)));
    claims.timing("their drives SAFE after, ms", SAFE_MS, safe);
    known_ms
}

/// When and how each of these nodes detected the loss of another one. Returns the milliseconds until all had.
fn noticed(claims: &mut Claims<'_>, name: &str, why: LossReason, losses: &[Option<Loss<'_>>]) -> Option<f64> {
    let known_ms = all(losses.iter().map(|loss| Some(loss.as_ref()?.after_ms)));
    claims.timing(name, LOST_MS, known_ms);
    let bound = all(losses.iter().map(|loss| loss.as_ref()?.bound_ms));
    claims.info("its bound, by the settings of discovery, ms", bound);
    let why = format!("{why:?}");
    let others = losses.iter().flatten().filter(|loss| loss.why != why).count();
    claims.exactly(&format!("nodes that give another reason than {why}"), 0, others);
    known_ms
}

fn return_node(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let ready = evidence.state_after_ms(Joint::Knee, injection.at, DriveState::Ready);
    claims.timing("READY after its start, s", REJOIN_S, ready.map(|ms| ms * 1e-3));
    let [before, now] = epochs_of_the_knee(evidence, injection);
    claims.is_so("it joins with a new epoch", before.zip(now).is_some_and(|(before, now)| now > before));
    back_to_walking(claims, evidence, injection);
}

/// The incarnations in which central last found the knee's node before this step, and in it.
fn epochs_of_the_knee(evidence: &Evidence, injection: &Injection) -> [Option<u64>; 2] {
    let whole = span(injection.at, injection.until);
    [0..whole.start, whole].map(|span| {
        let events = evidence.events(Part::Central, span);
        let found = events.filter(|event| event.whom == "knee" && event.what != "node_lost");
        found.filter_map(|event| event.how.parse().ok()).last()
    })
}

/// No process has died: each side has lost the other.
fn cut_link(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let knee = Part::Joint(Joint::Knee);
    let away = span(injection.at, injection.until);
    let known_there_ms =
        loss_of(claims, evidence, (knee, LossReason::LinkDown), &[Joint::Hip, Joint::Ankle], &away);
    let alone = evidence.safe_after_ms(Joint::Knee, injection.at);
    claims.timing("the isolated knee SAFE by its own timer after, ms", LOST_MS, alone);
    let others = Part::ALL.into_iter().filter(|part| *part != knee);
    let losses: Vec<_> = others.map(|part| evidence.node_lost(knee, part, away.clone())).collect();
    let known_here_ms =
        noticed(claims, "NODE_LOST of every other at the knee after, ms", LossReason::LinkDown, &losses);
    stay_safe(claims, evidence, &Joint::ALL, (&away, all([known_there_ms, known_here_ms])));
    claims.exactly("drives that were started anew", 0, evidence.incarnations_begun(&away));
}

/// These drives are safe, and stay so while a part is missing. The claim starts soon after all nodes knew,
/// which is `known_ms` after the fault. How soon they know is a time, and no claim about function.
fn stay_safe(
    claims: &mut Claims<'_>,
    evidence: &Evidence,
    drives: &[Joint],
    (away, known_ms): (&Span, Option<f64>),
) {
    let known = later(Time::from_nanos(away.start), known_ms).as_nanos();
    let safe = (known + SAFE_AT_LATEST_NS).min(away.end)..away.end;
    let left = evidence.ticks_not_in(DriveState::Safe, drives, &safe);
    claims.exactly("ticks out of SAFE, from 50 ms after all nodes knew", 0, left);
    claims.exactly(
        "samples of their devices with more than b*qd + 1 Nm",
        0,
        evidence.undamped(drives, &safe),
    );
}

fn join_link(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let ready = evidence.state_after_ms(Joint::Knee, injection.at, DriveState::Ready);
    claims.timing("READY after its link came back, s", REJOIN_S, ready.map(|ms| ms * 1e-3));
    let [before, now] = epochs_of_the_knee(evidence, injection);
    claims.is_so("it joins with the epoch that it had", now.is_some() && now == before);
    claims.exactly(
        "drives that were started anew",
        0,
        evidence.incarnations_begun(&span(injection.at, injection.until)),
    );
    back_to_walking(claims, evidence, injection);
}

/// All parts are back: nothing moves before the release, and then everything in its order.
fn back_to_walking(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let (Some(held), Some(released)) = (injection.when(Mark::Held), injection.when(Mark::Released)) else {
        claims.is_so("all parts are there again", false);
        return;
    };
    let still = held.as_nanos() + SETTLED_NS..released.as_nanos();
    claims.at_most("torque before the release, Nm", 0.0, evidence.torque_max_nm(&still));
    claims.at_most("gain of assistance before the release", 0.0, evidence.gain_max(&still));
    let moving = |row: &&GaitRow| matches!(row.mode, Some(GaitMode::Sync | GaitMode::Walk));
    let moved = evidence.gait(still).iter().filter(moving).count();
    claims.exactly("ticks in which central let anybody move before it", 0, moved);
    let after = span(released, injection.until);
    let walks = evidence.gait(after.clone()).iter().find(|row| row.mode == Some(GaitMode::Walk));
    let strikes = walks.map(|walks| {
        let rows = evidence.plant(after.start..walks.t_ns);
        let strides = |row: &PlantRow| row.strides.floor();
        rows.last().map_or(0.0, strides) - rows.first().map_or(0.0, strides)
    });
    claims.at_least("heel strikes until assistance is allowed", STRIKES_MIN, strikes);
    let ramp = evidence.ramp_ms(&Joint::ALL, &after);
    claims.at_least("assistance rises from none to full in, ms", RAMP_MIN_MS, ramp);
    let as_before = walks.and_then(|walks| as_before_s(evidence, injection, walks.t_ns));
    claims.timing("within 2 deg of before, s after it began to", AS_BEFORE_S, as_before);
}

/// Seconds from `from_ns` to the end of the first stride as good as the one before the fault.
fn as_before_s(evidence: &Evidence, injection: &Injection, from_ns: u64) -> Option<f64> {
    let fault = injection.at.as_nanos().saturating_sub(injection.away_ns());
    let rms = |from: u64| Joint::ALL.map(|joint| evidence.deviation_rms_deg(joint, from..from + STRIDE_NS));
    let before = rms(fault.saturating_sub(STRIDE_NS));
    let is_as_before = |from: &u64| {
        let pairs = before.iter().zip(rms(*from));
        pairs
            .into_iter()
            .all(|(before, now)| matches!((before, now), (Some(b), Some(n)) if n <= b + AS_BEFORE_DEG))
    };
    let ends = injection.until.as_nanos().saturating_sub(STRIDE_NS);
    let first = (from_ns..ends).step_by(50_000_000).find(is_as_before)?;
    Some((first + STRIDE_NS - from_ns) as f64 * 1e-9)
}

fn emergency_stop(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let at = injection.at;
    let stopped_ms = all(Joint::ALL.map(|joint| evidence.state_after_ms(joint, at, DriveState::EStop)));
    claims.timing("heard by all drives after, ms", STOP_HEARD_MS, stopped_ms);
    let reset = injection.when(Mark::ResetBegun).unwrap_or(injection.until);
    let is_still = |row: &&PlantRow| row.applied_nm.iter().all(|torque| torque.abs() < STOPPED_BELOW_NM);
    let still = evidence.plant(span(at, reset)).iter().find(is_still);
    let torque_ends = still.map(|row| ms_after(at, row.t_ns));
    claims.timing("all torques below 0.1 Nm after, ms", STOPPED_MS, torque_ends);
    let latched = span(later(at, stopped_ms), reset);
    let left = evidence.ticks_not_in(DriveState::EStop, &Joint::ALL, &latched);
    claims.exactly("ticks of a drive that is not stopped, until reset", 0, left);
    // How soon they receive it is a time.
    let stopped = (latched.start + STOPPED_NS).min(latched.end)..latched.end;
    claims.at_most("torque once stopped, Nm", 0.0, evidence.torque_max_nm(&stopped));
    let other = evidence.gait(stopped).iter().filter(|row| row.mode != Some(GaitMode::Stop)).count();
    claims.exactly("ticks in which central says anything else", 0, other);
    claims.is_so("resume is refused", injection.has_seen(Seen::ResumeRefused));
    claims.is_so("the reset is taken, by central and all drives", injection.has_seen(Seen::ResetTaken));
    back_to_walking(claims, evidence, injection);
}

fn insane_commands(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let whole = span(injection.at, injection.until);
    let counted = |count: &dyn Fn(&DriveRow) -> u32, from: Time, to: Time| {
        let mut rows = evidence.drive(Joint::Ankle, span(from, to));
        let first = rows.next().map_or(0, count);
        rows.last().map_or(0, count).saturating_sub(first)
    };
    let in_all = |count: &dyn Fn(&DriveRow) -> u32| f64::from(counted(count, injection.at, injection.until));
    claims.at_least("sane torques taken", 1.0, in_all(&|row| row.commands_taken));
    claims.at_least("NaN refused", 1.0, in_all(&|row| row.refused_not_finite));
    claims.at_least("500 Nm refused", 1.0, in_all(&|row| row.refused_out_of_range));
    claims.at_least("reversed sign refused", 1.0, in_all(&|row| row.refused_opposed));
    claims.at_least("old sequence number refused", 1.0, in_all(&|row| row.refused_old));
    if let (Some(from), Some(to)) = (injection.when(Mark::NotANumber), injection.when(Mark::Stranger)) {
        let taken = counted(&|row| row.commands_taken, from, to);
        claims.exactly("NaN, 500 Nm or reversed sign taken", 0, taken as usize);
    }
    let flagged = |row: &DriveRow| FaultBits(row.faults).contains(FaultBits::COMMAND_REFUSED);
    claims
        .is_so("fault bit COMMAND_REFUSED is set", evidence.drive(Joint::Ankle, whole.clone()).any(flagged));
    let stopped: usize = Joint::ALL
        .map(|joint| {
            evidence.drive(joint, whole.clone()).filter(|row| row.state == DriveState::EStop).count()
        })
        .iter()
        .sum();
    claims.exactly("drives' ticks stopped by a foreign command", 0, stopped);
    let unexplained = evidence.unexplained_safe(&Joint::ALL, &whole);
    claims.timing("SAFE without a stall of the host", [0.0, 0.0, REPORTED], Some(unexplained as f64));
    let deviation = evidence.deviation_max_deg(Joint::Ankle, whole);
    claims.info("greatest deviation of the ankle meanwhile, deg", deviation);
}

/// No part stops for a network that loses some packets, and the leg walks as well as before.
fn rough_network(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let rough = span(injection.at, injection.until);
    let safe = evidence.unexplained_safe(&Joint::ALL, &rough);
    claims.timing("SAFE without a stall of the host", [0.0, 0.0, REPORTED], Some(safe as f64));
    let assisted = evidence.share_in_percent(DriveState::Walk, &Joint::ALL, &rough);
    claims.info("ticks in which the least of the drives assists, %", Some(assisted));
    let ages = evidence.gait_ages_us(&rough);
    for (name, share) in [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)] {
        claims.info(
            &format!("age of the gait state in the drives, {name}, ms"),
            ages.at(share).map(|us| us * 1e-3),
        );
    }
    let clear = span(injection.when(Mark::Clear).unwrap_or(injection.at), injection.at);
    for joint in Joint::ALL {
        let [before, after] = [&clear, &rough].map(|span| evidence.deviation_rms_deg(joint, span.clone()));
        let grows = before.zip(after).map(|(before, after)| after - before);
        claims.timing(
            &format!("RMS of the {joint} grows by, deg"),
            [ROUGH_GROWS_DEG, ROUGH_GROWS_DEG, REPORTED],
            grows,
        );
    }
    let lost = Part::ALL.into_iter().flat_map(|part| evidence.events(part, rough.clone()));
    claims.exactly(
        "nodes that were said to be lost",
        0,
        lost.filter(|event| event.what == "node_lost").count(),
    );
}

fn kill_central(claims: &mut Claims<'_>, evidence: &Evidence, injection: &Injection) {
    let started = injection.when(Mark::Started).unwrap_or(injection.until);
    let (at, away) = (injection.at, span(injection.at, started));
    let known_ms = loss_of(claims, evidence, (Part::Central, LossReason::Crashed), &Joint::ALL, &away);
    stay_safe(claims, evidence, &Joint::ALL, (&away, known_ms));
    claims.exactly(
        "drives that were started anew",
        0,
        evidence.incarnations_begun(&span(at, injection.until)),
    );
    let held = injection.when(Mark::Held).map(|held| held.since(started).as_secs_f64());
    claims.timing("barrier passed again after its start, s", REJOIN_S, held);
    back_to_walking(claims, evidence, injection);
}
