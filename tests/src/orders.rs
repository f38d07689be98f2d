//! Orders of a scenario to the application of `process_under_test`, and its answers.

use sinew::prelude::*;

payload!("process.count", Bulk =>
    /// One of a sequence of numbers.
    #[derive(Debug)]
    pub struct Count {
        /// The number.
        pub number: u64,
    }
);

payload!("process.level", Stream =>
    /// A Stream value, of which the newest counts.
    #[derive(Debug)]
    pub struct Level {
        /// The value.
        pub value: u64,
    }
);

payload!("process.who" =>
    /// Asks for the process that handles messages now.
    #[derive(Debug)]
    pub struct Who {}
);

payload!("process.me" =>
    /// The answer.
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub struct Me {
        /// The process id.
        pub pid: u32,
        /// The numbers that this instance has handled.
        pub counts: Vec<u64>,
    }
);

payload!("process.order" =>
    /// An order to the application.
    #[derive(Debug)]
    pub enum Order {
        /// Panic.
        Panic,
        /// Stop in order.
        Stop,
        /// Block the thread for this many milliseconds.
        Hold(u64),
        /// Block the thread as long as this file exists.
        HoldWhile(String),
        /// Block forever.
        Hang,
        /// Exit with this code.
        Exit(i32),
        /// End the process by `abort`.
        Abort,
        /// Recurse without end.
        OverflowTheStack,
        /// Send SIGKILL to itself, as the kernel does when memory is short.
        Kill,
        /// Cause a memory fault, as far as safe code can.
        Segfault,
        /// Refuse this message.
        Refuse,
        /// Join this group.
        Join(String),
        /// Leave this group.
        Leave(String),
        /// Send a confirmed number to the application with this name, and print the outcome.
        Send(String, u64),
        /// Send this order, confirmed, to the application with this name, and print the outcome as that of
        /// number 0.
        SendOrder(String, Box<Self>),
        /// Send an unconfirmed number to the application with this TID.
        SendTo(u64),
        /// Send a number to the group with this name, confirmed by each member, and print the outcomes.
        SendToGroup(String),
        /// Send a [`Who`] request to the application with this name, and print the answer.
        Ask(String),
        /// Send these bytes, as this same order, to the application with this name.
        Echo(String, #[serde(with = "serde_bytes")] Vec<u8>),
        /// Set the message counter to the highest possible value, and send a message to the application with
        /// this name.
        ForgeNumbers(String),
        /// Start a command that exits at once, and print its exit status.
        StartACommand,
        /// Start a command that sleeps for two minutes, and print its process id; in its own process group,
        /// or not.
        StartASleeper(bool),
        /// Stop the current actix system.
        StopTheSystem,
    }
);
