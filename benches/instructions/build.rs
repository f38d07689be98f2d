//! Names the compiler: figures of another one are not compared.

use std::process::Command;

fn main() {
    let rustc = std::env::var_os("RUSTC").expect("cargo names the compiler");
    let output = Command::new(rustc).arg("--version").output().expect("the compiler runs");
    let text = String::from_utf8(output.stdout).expect("a version is text");
    // "rustc 1.95.0 (59807616e 2026-04-14)"
    let version = text.split(" (").next().unwrap_or_default();
    println!("cargo::rustc-env=SINEW_RUSTC={}", version.trim());
    println!("cargo::rerun-if-changed=build.rs");
}
