//! Sinew's endpoints as tokio tasks, each on a runtime with one thread: the same round trips through
//! `AsyncEndpoint`.

use sinew::{
    AsyncEndpoint, NodeApi, Registration, Tid,
    client::{DirectLinks, LoanedMessage},
};
use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, print_ready},
};
use sinew_runtime::wire::Kind;
use tokio::runtime::{Builder, Runtime};

use crate::{
    case::{Way, role},
    ends::{BLOCK, DEADLINE, Home},
};

fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().expect("a runtime")
}

async fn register(way: Way, socket: &str, name: &str) -> AsyncEndpoint {
    let api = NodeApi::connect(socket).expect("the node's door");
    let links = if way == Way::TaskDirect { DirectLinks::Always } else { DirectLinks::Never };
    let registration = Registration::new().name(name).direct(links);
    api.register_transport_address_async(registration).await.expect("an address")
}

fn filled(endpoint: &mut AsyncEndpoint, to: Tid, kind: Kind, bytes: &[u8]) -> LoanedMessage {
    let mut message = endpoint.create_message(to, kind, bytes.len()).expect("not too long");
    message.copy_from_slice(bytes);
    message
}

/// The application that echoes: until the measuring end ends this process.
pub(crate) fn echo(way: Way, socket: &str) {
    runtime().block_on(async {
        let mut endpoint = register(way, socket, "echo").await;
        print_ready();
        loop {
            let received = endpoint.receive().await.expect("the node lives");
            let back = filled(&mut endpoint, received.source(), received.kind(), received.bytes());
            endpoint.loaned(back).send().await.expect("the node takes it");
        }
    });
}

/// Round trips between two such applications.
pub(crate) fn round_trips(way: Way, bytes: usize, rounds: Rounds, pinning: Pinning) -> Figures {
    let home = Home::start(pinning);
    let _echo = Process::start(&role("echo", way, pinning, home.socket()));
    let runtime = runtime();
    let mut endpoint = runtime.block_on(register(way, home.socket(), "ping"));
    let to = runtime.block_on(endpoint.resolve("echo", DEADLINE)).expect("the node lives");
    let (to, mut buffer) = (to.expect("it is registered"), vec![7; bytes]);
    rounds.time(|| {
        runtime.block_on(async {
            let block = filled(&mut endpoint, to, BLOCK, &buffer);
            endpoint.loaned(block).send().await.expect("the node takes it");
            let back = endpoint.receive().await.expect("the echo answers");
            buffer.copy_from_slice(back.bytes());
        });
    })
}
