//! A malicious process on the node's own host, with the privileges of the node's user.

use std::{process::Command, thread};

use super::{super::KNEE, Happened, Scene, done};
use crate::{clients::hostile::Keeper, role};
use sinew_testkit::{NodeProcess, numbers};

const ATTACKERS: usize = 2;

pub(super) fn at_the_door(scene: &Scene<'_>) -> Happened {
    let host = &scene.hosts[KNEE];
    // On the same host, because the lingering socket is a connection to it.
    let keeper = host.run(Keeper::new);
    let mut counts: Vec<Vec<u64>> = Vec::new();
    thread::scope(|scope| {
        scope.spawn(|| keeper.keep(scene.over));
        let attackers: Vec<_> = (0..ATTACKERS)
            .map(|number| {
                // Like all attackers it gets only the CPU time that is left. Any program of this user could
                // take more, even without a node.
                let mut command = Command::new("nice");
                let attacker = role("attacker");
                command.args(["-n", "19"]).arg(attacker.get_program()).args(attacker.get_args());
                command.arg(scene.robot.socket());
                command.args([(number + 1).to_string(), scene.lasts.as_millis().to_string()]);
                command.arg(keeper.port().to_string());
                NodeProcess::start("attacker", host.moved(&command))
            })
            .collect();
        scene.rest(scene.lasts);
        for mut attacker in attackers {
            // It ends by itself.
            let code = attacker.wait_for_exit();
            assert_eq!(code, Some(0), "an attacker's exit");
            counts.extend(attacker.output().iter().map(|line| numbers(line)));
        }
    });
    let sum = |at: usize| counts.iter().filter_map(|counts| counts.get(at)).sum::<u64>();
    let broken = if sum(0) == 0 { vec!["no trick was played".to_owned()] } else { Vec::new() };
    Happened {
        done: done("tricks", sum(0)),
        ..Happened::new(
            format!("{} tricks on {} connections, {} refused in words", sum(0), sum(1), sum(3)),
            broken,
        )
    }
}
