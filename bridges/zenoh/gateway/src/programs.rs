//! The names of Zenoh programs at the node: each is a client of its own. Messages to it become puts and
//! queries.

use std::{collections::BTreeMap, time::Duration};

use sinew::{
    NodeApi, Outcome,
    client::{ApiError, Received},
    message::{Class, Rejection},
};
use sinew_bridge_node::{NodeClient, Options, Seen};
use sinew_zenoh_rules::{
    Encoding, Passed, Refusal,
    payload::inward,
    rules::{Origin, Program},
};
use tokio::{
    sync::{mpsc, watch},
    time::sleep,
};
use tracing::{info, warn};

use crate::{
    forward::{Prepared, ToZenoh, ignore},
    zenoh_sender::{Answer, Get, Job, Pending},
};

/// Maximum number of requests to a program that wait for their replies.
const WAITING_MAX: usize = 64;
/// Time until a name that the node has refused is tried again.
const AGAIN: Duration = Duration::from_secs(1);
/// Time limit of a registration.
const REGISTERED_WITHIN: Duration = Duration::from_secs(5);

/// A request that waits for a Zenoh program.
struct Waiting {
    request: Received,
    encoding: Encoding,
    reply: sinew::message::Kind,
}

/// A name, while it is registered.
struct Registered<'p> {
    client: NodeClient,
    to_zenoh: &'p ToZenoh,
    origin: Origin,
    waiting: BTreeMap<u64, Waiting>,
    next: u64,
    /// The sender of answers, for each request.
    answers: mpsc::Sender<(u64, Answer)>,
}

/// Has the name at the node while `is_there`, until the sender of that ends.
pub(crate) async fn run(
    node: NodeApi,
    program: Program,
    to_zenoh: ToZenoh,
    mut is_there: watch::Receiver<bool>,
) -> ApiError {
    let options = Options {
        types: to_zenoh.shared.config.rules.types_of(Some(&program.name)),
        name: Some(program.name.clone()),
        within: REGISTERED_WITHIN,
        ..Options::default()
    };
    loop {
        if is_there.wait_for(|is_there| *is_there).await.is_err() {
            return ApiError::Closed("the session of Zenoh has ended".to_owned());
        }
        match NodeClient::register(&node, &options).await {
            Ok(client) => {
                info!("{} is there", program.name);
                if let Err(why) = serve(client, &program.name, &to_zenoh, &mut is_there).await {
                    warn!("{}: {why}", program.name);
                    sleep(AGAIN).await;
                }
            }
            Err(why) => {
                warn!("{} is not registered, tried again: {why}", program.name);
                sleep(AGAIN).await;
            }
        }
    }
}

async fn serve(
    client: NodeClient,
    name: &str,
    to_zenoh: &ToZenoh,
    is_there: &mut watch::Receiver<bool>,
) -> Result<(), ApiError> {
    // Each waiting request has room for its answer, and so have those of before a reconnection.
    let (answers, mut answered) = mpsc::channel(4 * WAITING_MAX);
    let origin = Origin::Name(name.to_owned());
    let mut registered = Registered { client, to_zenoh, origin, waiting: BTreeMap::new(), next: 0, answers };
    loop {
        tokio::select! {
            seen = registered.client.receive() => match seen {
                Ok(seen) => registered.take(seen),
                // Nothing waits for replies any more.
                Err(ApiError::Disconnected(_)) => registered.waiting.clear(),
                Err(why) => return Err(why),
            },
            Some((number, answer)) = answered.recv() => registered.answer(number, answer).await,
            gone = is_there.wait_for(|is_there| !*is_there) => {
                drop(gone);
                info!("{name} has gone");
                return registered.client.unregister().await;
            }
        }
    }
}

impl Registered<'_> {
    fn take(&mut self, seen: Seen) {
        let Seen::Message(received) = seen else { return ignore(seen) };
        if received.destination() != self.client.tid() {
            // Messages to all applications pass once, by the bridge's own client.
            return ignore(Seen::Message(received));
        }
        if !received.wants_reply() {
            return self.to_zenoh.put(received, Some(&self.origin));
        }
        if let Err((why, rejection, received)) = self.ask(received) {
            self.to_zenoh.refuse(why, &received, Some(&self.origin));
            received.settle(Outcome::Rejected(rejection));
        }
    }

    /// Asks the program.
    fn ask(&mut self, received: Received) -> Result<(), (Refusal, Rejection, Received)> {
        let prepared = match self.to_zenoh.prepare(&received, Some(&self.origin)) {
            Ok(prepared) => prepared,
            Err((why, rejection)) => return Err((why, rejection, received)),
        };
        let Prepared { route, key, payload, attachment } = prepared;
        let Some((_, reply)) = route.reply else {
            return Err((Refusal::NoRuleOut, Rejection::Unsupported, received));
        };
        if self.waiting.len() >= WAITING_MAX {
            return Err((Refusal::QueueFullOut, Rejection::QueueFull, received));
        }
        let (number, encoding) = (self.next, route.encoding);
        self.next += 1;
        let answer = Pending { number, to: Some(self.answers.clone()) };
        let get = Get { key, payload, encoding, attachment, within: route.within, answer };
        if let Err(Job::Get(mut get)) =
            self.to_zenoh.zenoh_sender.send(Class::Control, Job::Get(Box::new(get)))
        {
            get.answer.to = None;
            return Err((Refusal::QueueFullOut, Rejection::QueueFull, received));
        }
        self.waiting.insert(number, Waiting { request: received, encoding, reply });
        Ok(())
    }

    /// Passes the answer of the program on.
    async fn answer(&mut self, number: u64, answer: Answer) {
        let Some(Waiting { request, encoding, reply }) = self.waiting.remove(&number) else { return };
        let shared = &self.to_zenoh.shared;
        let (detail, outcome) = match answer {
            Some(Ok(payload)) => match inward(&payload, encoding, None) {
                Ok(payload) => match self.client.reply(&request, reply, &payload).await {
                    Ok(()) => return shared.pass(Passed::AskedOut),
                    Err(why) => (why.to_string(), Outcome::Failed),
                },
                Err(_) => ("its reply is malformed".to_owned(), Outcome::Failed),
            },
            Some(Err(error)) => (error, Outcome::Rejected(Rejection::ByHandler)),
            None => (String::new(), Outcome::Unknown),
        };
        let what = format!("a request of {}", request.source());
        shared.refuse(Refusal::NoReply, &what, &detail);
        request.settle(outcome);
    }
}
