//! The role of one that lets everybody have a direct link with it, and answers whatever comes: in a thread, or in a task.

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
    client::{ApiError, Received},
};

use super::{registration::register, say, told};
use crate::puppet::Order;

/// Their names, and whether each is a task.
pub(super) const HOSTS: [(&str, bool); 2] = [("host in a thread", false), ("host in a task", true)];

/// So long it waits for room in the ring of one that takes nothing. Others wait meanwhile.
const PATIENCE: Duration = Duration::from_millis(2);
/// Time between two looks whether it is to end.
const LOOK: Duration = Duration::from_millis(100);

/// `SOCKET NAME`: answers questions, sends something back to whoever sends anything else, and asks some of them what became of it.
pub(super) fn play(arguments: &[String]) {
    let [socket, name] = arguments else { panic!("{arguments:?} are not a socket and a name") };
    let is_task = HOSTS.iter().any(|(one, is_task)| one == name && *is_task);
    let api = NodeApi::connect(socket).expect("the door is open");
    let registration = Registration::new().direct(true).name(name.as_str()).stall_timeout(PATIENCE);
    let over = Arc::new(AtomicBool::new(false));
    let ends = over.clone();
    let host = thread::spawn(move || {
        if is_task {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            runtime.expect("a runtime").block_on(async {
                let endpoint = api.register_transport_address_async(registration).await.expect("an address");
                say(&"up");
                be_a_task(endpoint, &ends).await;
            });
        } else {
            let endpoint = register(&api, &registration);
            say(&"up");
            be_a_thread(endpoint, &ends);
        }
    });
    told().for_each(drop);
    over.store(true, Ordering::Relaxed);
    host.join().expect("the node lives as long as this");
}

/// What is done about a message.
enum Answer {
    Reply(Order),
    Send,
    SendConfirmed,
}

fn answer(received: &Received) -> Answer {
    match received.decode::<Order>() {
        Ok(question) if received.kind() == Order::KIND && received.wants_reply() => Answer::Reply(question),
        // What decides is what the other one has sent.
        Ok(_) | Err(_) if received.bytes().len().is_multiple_of(16) => Answer::SendConfirmed,
        Ok(_) | Err(_) => Answer::Send,
    }
}

fn be_a_thread(mut endpoint: Endpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let received = match endpoint.receive(LOOK) {
            Ok(Some(received)) => received,
            Ok(None) => continue,
            Err(error) => panic!("{error}"),
        };
        let (to, order) = (received.source(), Order { number: 1 });
        // Whoever is hostile takes nothing, or is gone.
        let _: Result<(), ApiError> = match answer(&received) {
            Answer::Reply(question) => endpoint.reply(&received, &question),
            Answer::Send => endpoint.send(to, &order),
            Answer::SendConfirmed => endpoint.message(to, &order).confirmed(PATIENCE).map(drop),
        };
    }
}

async fn be_a_task(mut endpoint: AsyncEndpoint, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let received = match tokio::time::timeout(LOOK, endpoint.receive()).await {
            Ok(Ok(received)) => received,
            Err(_) => continue,
            Ok(Err(error)) => panic!("{error}"),
        };
        let (to, order) = (received.source(), Order { number: 1 });
        // Whoever is hostile takes nothing, or is gone.
        let _: Result<(), ApiError> = match answer(&received) {
            Answer::Reply(question) => endpoint.reply(&received, &question).await,
            Answer::Send => endpoint.send(to, &order).await,
            Answer::SendConfirmed => endpoint.message(to, &order).confirmed(PATIENCE).await.map(drop),
        };
    }
}
