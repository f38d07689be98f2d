//! Sinew's applications on two nodes, in two processes.

use sinew::prelude::*;
use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, await_end, print_ready},
};

use crate::{
    nodes::At,
    path::{Path, echo_role},
    ping::{self, DEADLINE},
};

/// Round trips between two applications.
pub(crate) fn measure(path: Path, rounds: Rounds, pinning: Pinning) -> Figures {
    let at = At::loopback();
    let _echo = Process::start(&echo_role(path, rounds.bytes, pinning, &at.host(2).to_string()));
    let (ping, figures) = ping::ping(rounds);
    let node = at.node("ping").app(place(path, ping)).start().expect("a node");
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    figures
}

/// The node that echoes.
pub(crate) fn echo(path: Path, at: &str) {
    let _node = At::read(at).node("echo").app(place(path, ping::echo())).start().expect("a node");
    print_ready();
    await_end();
}

fn place<A>(path: Path, app: AppSpec<A>) -> AppSpec<A>
where
    A: Actor<Context = AppContext<A>>,
{
    if path == Path::NodesIo { app.on_io_thread() } else { app.own_thread() }
}
