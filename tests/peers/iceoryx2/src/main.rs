//! Round trips through iceoryx2 between two processes: payload in shared memory, woken by its events or polled.
//!
//! `peer-iceoryx2 event|poll BYTES WARM_UP ROUNDS PAUSE_US CPU CPU` prints the time of each round trip in nanoseconds, one a
//! line. A CPU of `-` means any. It starts itself once more as the echoing end, and ends that.

use std::{
    error::Error,
    io::{BufRead, BufReader, Write},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use iceoryx2::{
    port::{listener::Listener, notifier::Notifier, publisher::Publisher, subscriber::Subscriber},
    prelude::*,
};
use rustix::thread::{CpuSet, sched_setaffinity};

type Outcome<T> = Result<T, Box<dyn Error>>;

/// No wait is longer.
const DEADLINE: Duration = Duration::from_secs(20);

fn main() -> Outcome<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[..] {
        ["echo", run, waits, bytes, cpu] => echo(run, waits == "event", bytes.parse()?, cpu),
        [waits @ ("event" | "poll"), bytes, warm_up, rounds, pause_us, cpu, cpu_of_echo] => {
            let rounds = (warm_up.parse()?, rounds.parse()?, Duration::from_micros(pause_us.parse()?));
            measure(waits, bytes.parse()?, rounds, cpu, cpu_of_echo)
        }
        _ => Err("event|poll BYTES WARM_UP ROUNDS PAUSE_US CPU CPU".into()),
    }
}

fn measure(waits: &str, bytes: usize, rounds: (u32, u32, Duration), cpu: &str, cpu_of_echo: &str) -> Outcome<()> {
    pin(cpu)?;
    let run = std::process::id().to_string();
    let mut end = End::new(&run, ["there", "back"], waits == "event", bytes)?;
    let _echo = Echo::start(&["echo", &run, waits, &bytes.to_string(), cpu_of_echo])?;
    let (warm_up, counted, pause) = rounds;
    let (mut buffer, mut times) = (vec![7; bytes], Vec::new());
    for round in 0..warm_up + counted {
        if !pause.is_zero() {
            thread::sleep(pause);
        }
        let start = Instant::now();
        end.send(&buffer)?;
        end.receive(&mut buffer)?;
        let time = start.elapsed();
        if round >= warm_up {
            times.push(time.as_nanos());
        }
    }
    let lines: String = times.iter().map(|time| format!("{time}\n")).collect();
    std::io::stdout().write_all(lines.as_bytes())?;
    Ok(())
}

/// Until the measuring end ends this process.
fn echo(run: &str, wakes: bool, bytes: usize, cpu: &str) -> Outcome<()> {
    pin(cpu)?;
    let mut end = End::new(run, ["back", "there"], wakes, bytes)?;
    println!("there");
    let mut buffer = vec![0; bytes];
    loop {
        end.receive(&mut buffer)?;
        end.send(&buffer)?;
    }
}

/// The other process; it is ended when this is dropped.
struct Echo(Child);

impl Echo {
    fn start(words: &[&str]) -> Outcome<Self> {
        let mut child = Command::new(std::env::current_exe()?).args(words).stdout(Stdio::piped()).spawn()?;
        let output = child.stdout.take().ok_or("its output is a pipe")?;
        BufReader::new(output).read_line(&mut String::new())?;
        Ok(Self(child))
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// One end of both directions.
struct End {
    outward: Publisher<ipc::Service, [u8], ()>,
    inward: Subscriber<ipc::Service, [u8], ()>,
    /// Whom to wake, and by what to be woken; `None`: both look all the time.
    bells: Option<(Notifier<ipc::Service>, Listener<ipc::Service>)>,
}

impl End {
    fn new(run: &str, [outward, inward]: [&str; 2], wakes: bool, bytes: usize) -> Outcome<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let name = |direction: &str| format!("sinew-peer-{run}-{direction}");
        let data = |direction: &str| -> Outcome<_> {
            let service = node.service_builder(&name(direction).as_str().try_into()?);
            Ok(service.publish_subscribe::<[u8]>().open_or_create()?)
        };
        let bell = |direction: &str| -> Outcome<_> {
            Ok(node.service_builder(&name(direction).as_str().try_into()?).event().open_or_create()?)
        };
        let bells = if wakes {
            let (there, back) = (bell(outward)?, bell(inward)?);
            Some((there.notifier_builder().create()?, back.listener_builder().create()?))
        } else {
            None
        };
        Ok(Self {
            outward: data(outward)?.publisher_builder().initial_max_slice_len(bytes).create()?,
            inward: data(inward)?.subscriber_builder().create()?,
            bells,
        })
    }

    fn send(&self, payload: &[u8]) -> Outcome<()> {
        self.outward.loan_slice_uninit(payload.len())?.write_from_slice(payload).send()?;
        if let Some((notifier, _)) = &self.bells {
            notifier.notify()?;
        }
        Ok(())
    }

    fn receive(&mut self, payload: &mut [u8]) -> Outcome<()> {
        loop {
            if let Some(sample) = self.inward.receive()? {
                payload.copy_from_slice(sample.payload());
                return Ok(());
            }
            match &self.bells {
                Some((_, listener)) => drop(listener.timed_wait(|_| {}, DEADLINE)?),
                None => std::hint::spin_loop(),
            }
        }
    }
}

fn pin(cpu: &str) -> Outcome<()> {
    if cpu != "-" {
        let mut set = CpuSet::new();
        set.set(cpu.parse()?);
        sched_setaffinity(None, &set)?;
    }
    Ok(())
}
