//! Passes on the run path of a MuJoCo that lies outside the system's library path.
//!
//! Cargo hands link arguments to the package that asks for them only, so every package with a binary, test, example
//! or benchmark of its own (this one, `aviary`, `cli`) runs this same script.

fn main() {
    println!("cargo::rerun-if-env-changed=DEP_MUJOCO_RS_RPATH");
    if let Ok(rpath) = std::env::var("DEP_MUJOCO_RS_RPATH") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{rpath}");
    }
}
