//! The stop of the whole system as a service: it presses, and never releases.

use std::{path::Path, sync::mpsc, time::Duration};

use sinew::{NodeApi, Registration, client::ApiError, stop::StopReport};
use sinew_ros2_core::Value;
use tracing::warn;

use crate::{counts::Counts, service::Request};

/// Time between two looks at the connection with the node.
const POLLED_EVERY: Duration = Duration::from_millis(100);
/// Time after which a node is tried again.
const RETRIED_AFTER: Duration = Duration::from_secs(1);
/// Time limit of the registration: a press waits for it while the node is away.
const REGISTERED_WITHIN: Duration = Duration::from_secs(2);
/// Nodes that a response names.
const NAMED_MAX: usize = 8;

/// Presses the stop for each request, until the program ends.
///
/// # Errors
/// The service has ended.
pub(crate) fn run(
    socket: &Path,
    name: &str,
    requests: &mpsc::Receiver<Request<Duration>>,
    counts: &Counts,
) -> Result<(), String> {
    let mut endpoint = None;
    loop {
        if endpoint.is_none() {
            let registration = Registration::new().name(name).deadline(REGISTERED_WITHIN);
            let registered =
                NodeApi::connect(socket).and_then(|node| node.register_transport_address(registration));
            match registered {
                Ok(registered) => endpoint = Some(registered),
                Err(why) => warn!("stop: {why}; tries again each second"),
            }
        }
        let within = if endpoint.is_some() { POLLED_EVERY } else { RETRIED_AFTER };
        let request = match requests.recv_timeout(within) {
            Ok(request) => request,
            Err(mpsc::RecvTimeoutError::Disconnected) => return Err("its service has ended".to_owned()),
            Err(mpsc::RecvTimeoutError::Timeout) => {
                // Keeps the connection, and finds its end.
                if let Some(Err(ApiError::Closed(_))) = endpoint.as_mut().map(|it| it.receive(Duration::ZERO))
                {
                    endpoint = None;
                }
                continue;
            }
        };
        let Some(endpoint) = endpoint.as_mut() else {
            request
                .fail("NOT STOPPED: the node cannot be reached; use the switch that cuts the power", counts);
            continue;
        };
        let reason = format!("{} of ROS 2", request.topic);
        match endpoint.press_stop(&reason, request.of) {
            Ok(report) => {
                let (is_stopped, text) = told(&report);
                request.reply(&Value::Message(vec![Value::Bool(is_stopped), Value::Text(text)]), counts);
            }
            Err(why) => request.fail(&format!("it may not be stopped: {why}"), counts),
        }
    }
}

/// Returns whether all nodes have confirmed, and a text for a person.
fn told(report: &StopReport) -> (bool, String) {
    if let Some(why) = &report.refused {
        return (false, format!("not stopped: {why}"));
    }
    if report.is_confirmed() {
        return (true, format!("stopped: {} nodes have confirmed", report.nodes.len()));
    }
    let open: Vec<_> = report.nodes.iter().filter(|node| node.confirmed_us.is_none()).collect();
    let names: Vec<_> = open.iter().take(NAMED_MAX).map(|node| node.name.as_str()).collect();
    let more = open.len().saturating_sub(NAMED_MAX);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    (
        false,
        format!(
            "pressed, but not confirmed by {}{more}; `sinew stop status` shows the state",
            names.join(", ")
        ),
    )
}
