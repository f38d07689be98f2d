//! A Zenoh router for tests: `sinew-zenoh-router LEASE_MS LISTEN[,LISTEN] [CONNECT,CONNECT]`. In the field use
//! `zenohd`.

use std::{io::Write as _, process::ExitCode, thread, time::Duration};

use sinew_zenoh::session::{Role, open};

fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn");
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let (lease, listen, connect) = match &arguments[..] {
        [lease, listen] => (lease, listen, None),
        [lease, listen, connect] => (lease, listen, Some(connect)),
        _ => return usage(),
    };
    let Ok(lease) = lease.parse().map(Duration::from_millis) else { return usage() };
    let list = |text: &String| text.split(',').map(str::to_owned).collect::<Vec<_>>();
    let (listen, connect) = (list(listen), connect.map(list).unwrap_or_default());
    match open(Role::Router { listen: &listen, connect: &connect }, lease) {
        Ok(_session) => {
            // The reader of this line may have ended.
            let _ = writeln!(std::io::stdout(), "router");
            // It ends by a signal.
            loop {
                thread::park();
            }
        }
        Err(error) => {
            tracing::error!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn usage() -> ExitCode {
    tracing::error!("usage: sinew-zenoh-router LEASE_MS LISTEN[,LISTEN] [CONNECT[,CONNECT]]");
    ExitCode::from(2)
}
