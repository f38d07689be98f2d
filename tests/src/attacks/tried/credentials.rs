//! Who shows what is not his, or nothing.

use std::{sync::Arc, time::Duration};

use super::{
    super::{
        ATTACKER,
        keys::{self, Who},
        stranger::{Answer, Client, Stranger, client},
    },
    Happened, Scene,
};
use crate::clients::Performer;

/// Time between two handshakes.
const PACE: Duration = Duration::from_millis(20);

/// What became of handshakes.
#[derive(Default)]
struct Tally {
    tried: u64,
    came_in: u64,
    words: Option<String>,
}

impl Tally {
    fn happened(self, who: &str) -> Happened {
        let Self { tried, came_in, words } = self;
        let words = words.unwrap_or_else(|| "nothing".to_owned());
        let mut broken = Vec::new();
        if came_in > 0 {
            broken.push(format!("{who}: {came_in} of {tried} came in"));
        }
        if tried == 0 {
            broken.push(format!("{who}: nothing was tried"));
        }
        Happened { what: format!("{who}: {tried} tried, {came_in} came in; told: {words}"), broken }
    }
}

/// Shows this, and says that it is `says`, again and again for so long.
fn shake(scene: &Scene<'_>, lasts: Duration, shows: Option<&Arc<Client>>, says: Who) -> Tally {
    let until = std::time::Instant::now() + lasts;
    let mut tallies = scene.on_threads(1, |_| {
        let mut tally = Tally::default();
        while !scene.is_over() && std::time::Instant::now() < until {
            tally.tried += 1;
            let answer = Stranger::dial(scene.robot.knee(), shows)
                .and_then(|mut stranger| stranger.hello(says, scene.robot.knee_address()));
            match answer {
                Ok(Answer::Welcome) => tally.came_in += 1,
                Ok(Answer::Refused(words)) => tally.words = Some(words),
                Err(error) => tally.words = tally.words.or_else(|| Some(error.to_string())),
            }
            scene.rest(PACE);
        }
        tally
    });
    tallies.pop().unwrap_or_default()
}

fn together(parts: Vec<Happened>) -> Happened {
    let what = parts.iter().map(|part| &*part.what).collect::<Vec<_>>().join("; ");
    Happened { what, broken: parts.into_iter().flat_map(|part| part.broken).collect() }
}

pub(super) fn wrong_authority(scene: &Scene<'_>) -> Happened {
    let theirs = scene.keys.of_others(keys::MALLORY);
    // It never gets an answer, and so never comes up.
    let command = scene.robot.foreign_node(&scene.hosts[ATTACKER], Some(&theirs));
    let node =
        Performer::start_command(command, "robot-node", |line| assert_ne!(line, "up", "it has got in"));
    let by = scene.keys.tls_of_others(keys::MALLORY);
    let half = scene.lasts / 2;
    let own = shake(scene, half, Some(&by), keys::MALLORY).happened("as itself");
    let by = scene.keys.tls_of_others(keys::HIP);
    let hip = shake(scene, half, Some(&by), keys::HIP).happened("as hip, with a certificate that says so");
    drop(node);
    together(vec![own, hip])
}

pub(super) fn none(scene: &Scene<'_>) -> Happened {
    let half = scene.lasts / 2;
    let tls = shake(scene, half, Some(&client(None)), keys::MALLORY).happened("TLS");
    let open = shake(scene, half, None, keys::MALLORY).happened("without TLS");
    together(vec![tls, open])
}

pub(super) fn stolen(scene: &Scene<'_>) -> Happened {
    let (third, spare) = (scene.lasts / 3, scene.keys.tls(keys::SPARE));
    let hip = shake(scene, third, Some(&spare), keys::HIP).happened("as hip");
    let knee = shake(scene, third, Some(&spare), keys::KNEE).happened("as knee itself");
    let revoked = scene.keys.tls(keys::REVOKED);
    let revoked = shake(scene, third, Some(&revoked), keys::REVOKED).happened("revoked");
    together(vec![hip, knee, revoked])
}
