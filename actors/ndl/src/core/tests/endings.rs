//! How a broken connection and a leave end a member, and how it returns.

use sinew_model::{
    facts::{LinkFact, LossReason, MembershipFact},
    leave_reason::LeaveReason,
};
use sinew_runtime::tid::Incarnation;

use super::{
    scenarios::bytes,
    world::{PERIOD, Spec, World, ms, node, place, udp},
};
use crate::{
    core::Input,
    datagram::{Answer, Body, Leave},
};

// spec: NDL-4.3
#[test]
fn broken_and_refused_connection_is_a_loss_at_once() {
    let mut world = World::of_members(2);
    let (node, incarnation) = (node(2), Incarnation(1));
    world.kill(2);
    world.link(1, LinkFact::DialRefused { node, incarnation });
    world.link(1, LinkFact::LinkBroken { node, incarnation });
    assert_eq!(world.losses(1), [], "refused before it was up, or only broken");
    world.link(1, LinkFact::DialRefused { node, incarnation: Incarnation(0) });
    assert_eq!(world.losses(1), [], "a former incarnation");
    world.link(1, LinkFact::DialRefused { node, incarnation });
    assert_eq!(world.losses(1), [(2, LossReason::Crashed)]);
}

// spec: NDL-4.3
#[test]
fn answer_after_a_link_break_outweighs_a_refusal() {
    let mut world = World::of_members(2);
    let (node, incarnation) = (node(2), Incarnation(1));
    let refused = || LinkFact::DialRefused { node, incarnation };
    world.link(1, LinkFact::LinkBroken { node, incarnation });
    // Between two dials
    for _ in 0..5 {
        world.run(ms(10));
        world.link(1, refused());
    }
    assert_eq!(world.losses(1), []);
    // But after its end the next refusal is the loss.
    world.kill(2);
    world.run(ms(10));
    world.link(1, refused());
    assert_eq!(world.losses(1), [(2, LossReason::Crashed)]);
}

// spec: NDL-2.2
#[test]
fn node_restarted_in_place_is_found_at_once() {
    let mut world = World::of_members(2);
    let (node, incarnation) = (node(2), Incarnation(1));
    world.kill(2);
    world.link(1, LinkFact::LinkBroken { node, incarnation });
    world.run(ms(3));
    world.start(2, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run(ms(5));
    let is_back =
        |fact: &MembershipFact| matches!(fact, MembershipFact::NodeFound { incarnation: Incarnation(2), .. });
    assert!(world.at(1).facts.iter().any(is_back), "{:?}", world.at(1).facts);
}

#[test]
fn refused_node_that_answers_is_found_again() {
    // given: an answer to an earlier query is in flight
    let mut world = World::of_members(2);
    let (node, incarnation) = (node(2), Incarnation(1));
    world.link(1, LinkFact::LinkBroken { node, incarnation });
    world.cut(1, 2);
    world.link(1, LinkFact::DialRefused { node, incarnation });
    world.run(ms(1));
    assert!(!world.has_member(1, 2));
    // when
    world.mend();
    // then
    world.run_until(PERIOD + ms(2), |world| world.has_member(1, 2));
}

// spec: NDL-4.4
#[test]
fn leaving_node_has_left_and_can_return() {
    let mut world = World::of_members(2);
    world.input(2, Input::Stopping);
    world.run(ms(1));
    assert_eq!(world.losses(1), [(2, LossReason::Left)]);
    world.restart_shell(2);
    world.run_until(ms(1), |world| world.has_member(1, 2));
}

#[test]
fn forged_or_outdated_leave_changes_nothing() {
    let mut world = World::of_members(2);
    let mut me = world.at(2).core.announcement().clone();
    world.forge(udp(3), 1, &bytes(0, Body::Leave(me.clone().into())));
    me.boot_nonce += 1;
    world.forge(udp(2), 1, &bytes(0, Body::Leave(me.into())));
    assert_eq!(world.losses(1), []);
    assert_eq!(world.at(1).core.refusals().of("NDL leave of a stranger"), 2);
}

/// Found by the simulation.
#[test]
fn answer_from_before_a_leave_is_ignored() {
    // given: lost as silent, it is queried again; its leave overtakes its answer
    let mut world = World::of_members(2);
    world.cut(2, 1);
    world.run_until(PERIOD * 5, |world| !world.has_member(1, 2));
    let contact = &world.at(1).core.contacts[&place(1, udp(2))];
    let correlation = contact.queries.newest().expect("it is queried again at once").correlation;
    let announcement = world.at(2).core.announcement().clone();
    // when
    world.forge(udp(2), 1, &bytes(0, Body::Leave(announcement.clone().into())));
    let answer =
        Answer { announcement, query_sent_ns: 0, query_received_ns: 0, progress: Default::default() };
    world.forge(udp(2), 1, &bytes(correlation, Body::Answer(answer)));
    // then
    assert!(!world.has_member(1, 2));
}

#[test]
fn node_that_gives_up_reports_its_reason() {
    let words = LeaveReason::of("applications: more than 5 restarts");
    let lost = [(2, LossReason::GaveUp("applications: more than 5 restarts".to_owned()))];
    let mut world = World::of_members(2);
    let leave = Leave { announcement: world.at(2).core.announcement().clone(), gave_up: Some(words.clone()) };
    world.forge(udp(2), 1, &bytes(0, Body::Leave(leave)));
    assert_eq!(world.losses(1), lost);
    let mut world = World::of_members(2);
    let (node, incarnation) = (node(2), Incarnation(1));
    world.link(1, LinkFact::PeerLeft { node, incarnation, gave_up: Some(words) });
    assert_eq!(world.losses(1), lost);
}

#[test]
fn leave_on_the_connection_counts_as_well() {
    let mut world = World::of_members(2);
    world.link(1, LinkFact::PeerLeft { node: node(2), incarnation: Incarnation(1), gave_up: None });
    assert_eq!(world.losses(1), [(2, LossReason::Left)]);
}
