//! Attackers that open connections and send nothing.

use std::{
    collections::VecDeque,
    net::TcpStream,
    time::{Duration, Instant},
};

use super::{Happened, Scene, done};

const THREADS: usize = 4;
/// Connections held open at the same time, over all threads.
const HELD: usize = 10_000;
/// Connect timeout: beyond it the system has no capacity at the moment.
const TIMEOUT: Duration = Duration::from_millis(200);

pub(super) fn ten_thousand(scene: &Scene<'_>) -> Happened {
    let seen = scene.on_threads(THREADS, |_| {
        let (mut made, mut held, mut most, mut longest) = (0_u64, VecDeque::new(), 0, Duration::ZERO);
        while !scene.is_over() {
            let began = Instant::now();
            if let Ok(silent) = TcpStream::connect_timeout(&scene.target.connections, TIMEOUT) {
                made += 1;
                held.push_back(silent);
                longest = longest.max(began.elapsed());
            } else {
                // No ports or file descriptors are left, or the node's system has no capacity.
                std::thread::sleep(Duration::from_millis(1));
                held.pop_front();
            }
            most = held.len().max(most);
            if held.len() >= HELD / THREADS {
                held.pop_front();
            }
        }
        (made, most, longest)
    });
    let (made, most): (u64, usize) =
        seen.iter().fold((0, 0), |(made, most), one| (made + one.0, most + one.1));
    let longest = seen.iter().map(|one| one.2).max().unwrap_or_default();
    let mut broken = Vec::new();
    if made == 0 {
        broken.push("no connection was made".to_owned());
    }
    Happened {
        done: done("connections", made),
        ..Happened::new(
            format!("{made} made, {most} of {HELD} open at this end at once; the longest took {longest:.0?}"),
            broken,
        )
    }
}

/// The same against a node without enough file descriptors. The node must run out of them, otherwise this
/// proves nothing.
pub(super) fn until_none_are_left(scene: &Scene<'_>) -> Happened {
    Happened { refused: vec![("not accepted", 1)], ..ten_thousand(scene) }
}
