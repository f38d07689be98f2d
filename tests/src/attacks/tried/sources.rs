//! Who is in, and speaks for others.

use std::{io, time::Duration};

use sinew::{AppAddress, NodeAddress, Payload as _, Tid};
use sinew_runtime::wire::{Header, Kind};

use super::{
    super::{
        keys::{self, SPARE, Who},
        robot::Is,
        stranger::{Answer, Stranger, words},
    },
    Happened, Scene, done,
};
use crate::puppet::Order;

/// Messages in each millisecond.
const AT_ONCE: u64 = 5;
/// An application of the one that speaks.
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

/// Counts how many were `sent` in its own name, and in others'.
fn speak(scene: &Scene<'_>, sent: &mut [u64; 2]) -> io::Result<()> {
    let (peer, echo) = (scene.robot.knee_address(), scene.robot.echo());
    // It comes several times, and numbers its messages from 1 each time.
    let mut stranger =
        Stranger::dial(scene.target.connections, Some(&scene.keys.tls(SPARE)))?.in_a_new_life();
    match scene.target.is {
        Is::Node => begin(&mut stranger, peer)?,
        // It takes what comes, and says nothing.
        Is::Decoy => {}
    }
    let mut number = 0_u64;
    while !scene.is_over() {
        for says in [SPARE, keys::HIP, keys::KNEE, keys::HIP, keys::KNEE].into_iter().take(AT_ONCE as usize) {
            number += 1;
            stranger.send(&header(says, echo, number), &words(&Order { number }))?;
            sent[usize::from(says.host != SPARE.host)] += 1;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    if scene.target.is == Is::Node {
        stranger.wait_for_taken(number)?;
    }
    Ok(())
}

fn begin(stranger: &mut Stranger, peer: NodeAddress) -> io::Result<()> {
    if let Answer::Refused(why) = stranger.hello(SPARE, peer)? {
        return Err(io::Error::other(why));
    }
    stranger.begin_session(SPARE, peer)
}

fn header(says: Who, to: Tid, number: u64) -> Header {
    let mut header = Header::new(Kind::named(Order::NAME), Tid::new(says.node(), OWN), to);
    (header.number, header.sequence) = (number as u16, number);
    header
}
