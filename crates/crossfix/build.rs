//! Notes whether nasm was there when the program was built: with it H.264 is decoded twice as fast.

use std::process::Command;

fn main() {
    println!("cargo::rerun-if-env-changed=PATH");
    println!("cargo::rustc-check-cfg=cfg(has_nasm)");
    if Command::new("nasm").arg("-v").output().is_ok_and(|output| output.status.success()) {
        println!("cargo::rustc-cfg=has_nasm");
    }
}
