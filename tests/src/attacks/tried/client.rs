//! Who is on the node's own host, with its own user's rights, and means harm.

use std::{
    process::Command,
    sync::{Arc, Mutex, PoisonError},
    thread,
};

use super::{super::KNEE, Happened, Scene, done};
use crate::clients::{Performer, hostile::Keeper};

const ATTACKERS: usize = 2;

pub(super) fn at_the_door(scene: &Scene<'_>) -> Happened {
    let host = &scene.hosts[KNEE];
    // On the same host: what does not close is a connection to it.
    let keeper = host.run(Keeper::new);
    let said: Arc<Mutex<Vec<u64>>> = Arc::default();
    thread::scope(|scope| {
        scope.spawn(|| keeper.keep(scene.over));
        let attackers: Vec<_> = (0..ATTACKERS)
            .map(|number| {
                // As all attackers it has the CPU that is left: any program of this user could take that, without a node.
                let mut command = Command::new("nice");
                command
                    .args(["-n", "19"])
                    .arg(scene.program)
                    .args(["--role", "attacker"])
                    .arg(scene.robot.door());
                command.args([(number + 1).to_string(), scene.lasts.as_millis().to_string()]);
                command.arg(keeper.port().to_string());
                let said = said.clone();
                Performer::start_command(host.moved(&command), "attacker", move |line| {
                    let numbers = line.split_whitespace().filter_map(|word| word.parse::<u64>().ok());
                    said.lock().unwrap_or_else(PoisonError::into_inner).extend(numbers.take(4));
                })
            })
            .collect();
        scene.rest(scene.lasts);
        for attacker in attackers {
            // It ends by itself.
            let status = attacker.end();
            assert!(status.success(), "an attacker ended with {status}");
        }
    });
    let said = said.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let sum = |at: usize| said.iter().skip(at).step_by(4).sum::<u64>();
    let broken = if sum(0) == 0 { vec!["no trick was played".to_owned()] } else { Vec::new() };
    Happened {
        done: done("tricks", sum(0)),
        ..Happened::new(
            format!("{} tricks on {} connections, {} refused in words", sum(0), sum(1), sum(3)),
            broken,
        )
    }
}
