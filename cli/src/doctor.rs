use std::process::Command;

use anyhow::{Context as _, anyhow};
use clap::Args;
use mujoco_rs::{Camera, Data, GlBackend, ImageSize, Model, Quality, Renderer, Scene};
use serde_json::json;

use crate::failure::Failure;
use crate::output;

/// What the program needs from this machine, and whether it is there
///
/// Exit status 1 if something needed is missing, with the command that mends it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary doctor
  MUJOCO_GL=osmesa aviary doctor")]
pub struct Doctor {
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Draw with the library that MUJOCO_GL names and say how it went: what doctor asks of itself
    #[arg(long, hide = true)]
    probe: bool,
}

/// What a way to OpenGL answered.
struct Answer {
    backend: GlBackend,
    works: bool,
    detail: String,
}

impl Doctor {
    pub fn run(&self) -> Result<(), Failure> {
        if self.probe {
            return output::print(&draw().map_err(Failure::work)?);
        }
        let checked = mujoco_rs::check_library();
        let [major, minor, patch] = mujoco_rs::library_version();
        let version = format!("{major}.{minor}.{patch}");
        let answers = GlBackend::ALL.map(|backend| {
            let (works, detail) = ask(Some(backend));
            Answer { backend, works, detail }
        });
        // what every other command will meet, MUJOCO_GL and MUJOCO_EGL_DEVICE_ID included
        let (drawn, refusal) = ask(None);
        let ok = checked.is_ok() && drawn;

        if self.json {
            let gl: Vec<_> = answers
                .iter()
                .map(|answer| json!({ "backend": answer.backend.name(), "works": answer.works, "detail": answer.detail }))
                .collect();
            output::print_json(&json!({ "mujoco_version": version, "gl": gl, "ok": ok }))?;
        } else {
            let state = |works: bool, detail: &str| format!("{} ({detail})", if works { "works" } else { "no" });
            let mujoco = match &checked {
                Ok(()) => state(true, &version),
                Err(error) => state(false, &error.to_string()),
            };
            let mut rows = vec![("MuJoCo", mujoco)];
            rows.extend(answers.iter().map(|answer| (answer.backend.name(), state(answer.works, &answer.detail))));
            output::print(&output::table(&rows))?;
        }
        checked.map_err(|error| Failure::work(anyhow!("{error}: run `./setup` and build again")))?;
        if !drawn {
            return Err(Failure::work(anyhow!(refusal)));
        }
        Ok(())
    }
}

/// Whether drawing works with one library, or as the environment has it, and what was answered. In a process of its
/// own: a process keeps the first library that works.
fn ask(backend: Option<GlBackend>) -> (bool, String) {
    let tried = (|| {
        let program = std::env::current_exe().context("this program's own file")?;
        let mut command = Command::new(program);
        command.args(["doctor", "--probe"]);
        if let Some(backend) = backend {
            command.env("MUJOCO_GL", backend.name());
        }
        let output = command.output()?;
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().trim_start_matches("error: ").to_string();
        if output.status.success() {
            Ok(text(&output.stdout))
        } else {
            let error = text(&output.stderr);
            Err(anyhow!(if error.is_empty() { output.status.to_string() } else { error }))
        }
    })();
    match tried {
        Ok(detail) => (true, detail),
        Err(error) => (false, format!("{error:#}")),
    }
}

/// Draws a ball and looks whether it is there.
fn draw() -> anyhow::Result<String> {
    let mut data = Data::new(Model::from_xml("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")?)?;
    data.kinematics()?;
    let model = data.shared_model();
    let mut scene = Scene::new(model.clone(), 0)?;
    let camera = Camera::Free { lookat: [0.0; 3], distance: 4.0, azimuth: 0.0, elevation: 0.0 };
    scene.update(&mut data, &camera)?;
    let size = ImageSize { width: 9, height: 9 };
    let mut objects = vec![[0; 2]; size.pixels()];
    Renderer::new(model, Quality::FAST)?.segmentation(&mut scene, size, &mut objects)?;
    anyhow::ensure!(objects[40][1] == 0 && objects[0][1] == -1, "it draws, but not what it was given");
    Ok(mujoco_rs::gl_info()?.device)
}
