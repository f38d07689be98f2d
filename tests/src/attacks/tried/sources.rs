//! An authenticated peer that sends with forged sources.

use std::{io, time::Duration};

use sinew::{AppAddress, NodeAddress, Payload as _, Tid};
use sinew_runtime::wire::{Header, Kind};

use super::{
    super::{
        keys::{self, SPARE, TestNode},
        raw_peer::{Answer, RawPeer, words},
        robot::Is,
    },
    Happened, Scene, done,
};
use sinew_testkit::scripted::Order;

/// Messages per millisecond.
const AT_ONCE: u64 = 5;
/// An application of the sending peer.
const OWN: AppAddress = AppAddress::new(0x8000_0001);

pub(super) fn forged(scene: &Scene<'_>) -> Happened {
    let mut sent = scene.on_threads(1, |_| {
        let mut sent = [0; 2];
        (speak(scene, &mut sent), sent)
    });
    let (ended, [own, forged]) = sent.pop().unwrap_or((Ok(()), [0; 2]));
    match ended {
        Ok(()) => {
            let mut broken = Vec::new();
            if own == 0 || forged == 0 {
                broken.push("nothing was sent".to_owned());
            }
            let what = format!("{own} messages in its own name, {forged} in that of hip and of knee");
            Happened {
                own_sent: own,
                done: done("messages", own + forged),
                refused: vec![("forged source", forged)],
                ..Happened::new(what, broken)
            }
        }
        Err(error) => Happened {
            own_perhaps: own,
            ..Happened::new(format!("its link broke: {error}"), vec!["no link to try it on".to_owned()])
        },
    }
}

/// Counts in `sent` the messages in its own name and those in others' names.
fn speak(scene: &Scene<'_>, sent: &mut [u64; 2]) -> io::Result<()> {
    let (peer, echo) = (scene.robot.knee_address(), scene.robot.echo());
    // It connects several times, and numbers its messages from 1 each time.
    let mut raw_peer =
        RawPeer::dial(scene.target.connections, Some(&scene.keys.tls(SPARE)))?.in_a_new_incarnation();
    match scene.target.is {
        Is::Node => begin(&mut raw_peer, peer)?,
        // The decoy reads the data and sends nothing.
        Is::Decoy => {}
    }
    let mut number = 0_u64;
    while !scene.is_over() {
        for claimed in
            [SPARE, keys::HIP, keys::KNEE, keys::HIP, keys::KNEE].into_iter().take(AT_ONCE as usize)
        {
            number += 1;
            raw_peer.send(&header(claimed, echo, number), &words(&Order { number }))?;
            sent[usize::from(claimed.host != SPARE.host)] += 1;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    if scene.target.is == Is::Node {
        raw_peer.wait_for_taken(number)?;
    }
    Ok(())
}

fn begin(raw_peer: &mut RawPeer, peer: NodeAddress) -> io::Result<()> {
    if let Answer::Refused(why) = raw_peer.hello(SPARE, peer)? {
        return Err(io::Error::other(why));
    }
    raw_peer.begin_session(SPARE, peer)
}

fn header(claimed: TestNode, to: Tid, number: u64) -> Header {
    let mut header = Header::new(Kind::named(Order::NAME), Tid::new(claimed.node(), OWN), to);
    (header.number, header.sequence) = (number as u16, number);
    header
}
