//! The role of a process that accepts direct links from all clients and answers every message: in a thread,
//! or in a task.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use sinew::{
    AsyncEndpoint, Endpoint, NodeApi, Payload as _, Registration,
    client::{ApiError, DirectLinks, Received},
};

use super::{commands, print_line, registration::register};
use sinew_testkit::scripted::Order;

/// Names of the hosts, and whether each runs as a task.
pub(super) const HOSTS: [(&str, bool); 2] = [("host in a thread", false), ("host in a task", true)];

/// Maximum wait for room in the ring of a client that does not read. Other clients wait meanwhile.
const ROOM_TIMEOUT: Duration = Duration::from_millis(2);
/// Interval between checks for the end.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// `SOCKET NAME`: answers requests. To any other message it sends a reply message, for some of them with
/// confirmation.
pub(super) fn run(arguments: &[String]) {
    let [socket, name] = arguments else { panic!("{arguments:?} are not a socket and a name") };
    let is_task = HOSTS.iter().any(|(one, is_task)| one == name && *is_task);
    let api = NodeApi::connect(socket).expect("the node accepts clients");
    let registration = Registration::new().direct(DirectLinks::Always);
    let registration = registration.name(name.as_str()).stall_timeout(ROOM_TIMEOUT);
    let over = Arc::new(AtomicBool::new(false));
    let ends = over.clone();
    let host = thread::spawn(move || {
        if is_task {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            runtime.expect("a runtime").block_on(async {
                let endpoint = api.register_transport_address_async(registration).await.expect("an address");
                print_line(&"up");
                be_a_task(endpoint, &ends).await;
            });
        } else {
            let endpoint = register(&api, &registration);
            print_line(&"up");
            be_a_thread(endpoint, &ends);
        }
    });
    commands().for_each(drop);
    over.store(true, Ordering::Relaxed);
    host.join().expect("the node outlives this process");
}

/// The reaction to a message.
enum Answer {
    Reply(Order),
    Send,
    SendConfirmed,
}

fn answer(received: &Received) -> Answer {
    match received.decode::<Order>() {
        Ok(question) if received.kind() == Order::KIND && received.wants_reply() => Answer::Reply(question),
        // The content of the message decides.
        Ok(_) | Err(_) if received.bytes().len().is_multiple_of(16) => Answer::SendConfirmed,
        Ok(_) | Err(_) => Answer::Send,
    }
}

fn be_a_thread(mut endpoint: Endpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let received = match endpoint.receive(POLL_INTERVAL) {
            Ok(Some(received)) => received,
            Ok(None) => continue,
            Err(error) => panic!("{error}"),
        };
        let (to, order) = (received.source(), Order { number: 1 });
        // A hostile client may not read, or may have exited.
        let _: Result<(), ApiError> = match answer(&received) {
            Answer::Reply(question) => endpoint.reply(&received, &question),
            Answer::Send => endpoint.send(to, &order),
            Answer::SendConfirmed => endpoint.message(to, &order).confirmed(ROOM_TIMEOUT).map(drop),
        };
    }
}

async fn be_a_task(mut endpoint: AsyncEndpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let received = match tokio::time::timeout(POLL_INTERVAL, endpoint.receive()).await {
            Ok(Ok(received)) => received,
            Err(_) => continue,
            Ok(Err(error)) => panic!("{error}"),
        };
        let (to, order) = (received.source(), Order { number: 1 });
        // A hostile client may not read, or may have exited.
        let _: Result<(), ApiError> = match answer(&received) {
            Answer::Reply(question) => endpoint.reply(&received, &question).await,
            Answer::Send => endpoint.send(to, &order).await,
            Answer::SendConfirmed => endpoint.message(to, &order).confirmed(ROOM_TIMEOUT).await.map(drop),
        };
    }
}
