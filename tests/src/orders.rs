//! What a scenario tells the application of `process_under_test`, and what it answers.

use sinew::prelude::*;

payload!("process.count", Bulk =>
    /// One of a row of numbers.
    #[derive(Debug)]
    pub struct Count {
        /// The number.
        pub number: u64,
    }
);

payload!("process.level", Stream =>
    /// A value of which the newest counts.
    #[derive(Debug)]
    pub struct Level {
        /// The value.
        pub value: u64,
    }
);

payload!("process.who" =>
    /// Asks who handles messages now.
    #[derive(Debug)]
    pub struct Who {}
);

payload!("process.me" =>
    /// The answer.
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub struct Me {
        /// Its process.
        pub pid: u32,
        /// The numbers that this instance has handled.
        pub counts: Vec<u64>,
    }
);

payload!("process.order" =>
    /// What the application is to do.
    #[derive(Debug)]
    pub enum Order {
        /// Panic.
        Panic,
        /// Stop in order.
        Stop,
        /// Hold the thread for so many milliseconds.
        Hold(u64),
        /// Never come back.
        Hang,
        /// End the process with this code.
        Exit(i32),
        /// End the process by `abort`.
        Abort,
        /// Recurse without end.
        OverflowTheStack,
        /// Kill itself as the kernel does when memory is short.
        Kill,
        /// A memory fault, as far as safe code can have one.
        Segfault,
        /// Refuse this message.
        Refuse,
        /// Join this group.
        Join(String),
        /// Leave this group.
        Leave(String),
        /// Send a number to the application of this name, confirmed, and write down what becomes of it.
        Send(String, u64),
        /// Send a number to the application that has this TID, unconfirmed.
        SendTo(u64),
        /// Send a number to the group of this name, confirmed by each member, and write down what becomes of it.
        SendToGroup(String),
        /// Ask the application of this name who it is, and write down the answer.
        Ask(String),
        /// Send these bytes, in this very order, to the application of this name.
        Echo(String, #[serde(with = "serde_bytes")] Vec<u8>),
        /// Count its messages as if it had sent more than anybody can, and send one to the application of this name.
        ForgeNumbers(String),
        /// Start a command that ends at once, and write down how it ended.
        StartACommand,
        /// Start a command that sleeps for two minutes, and write down its process; in a group of its own, or not.
        StartASleeper(bool),
        /// Stop the system of actix that it finds.
        StopTheSystem,
    }
);
