//! Steps, divergence, shared models, and MuJoCo's errors.

use std::process::Command;
use std::sync::Arc;

use mujoco_rs::{BodyId, Data, DivergedQuantity, Error, GeomId, Model, WarningKind};

const BALL: &str = r#"<mujoco><option timestep="0.002" integrator="RK4"/>
  <worldbody><geom name="floor" type="plane" size="5 5 1"/>
  <body name="ball" pos="0 0 2"><freejoint/><geom name="ball" size=".1" mass="1"/></body></worldbody></mujoco>"#;

#[test]
fn a_ball_falls_as_in_the_closed_form_and_comes_to_rest_on_the_floor() {
    let mut data = Data::new(Model::from_xml(BALL).unwrap()).unwrap();
    for _ in 0..250 {
        data.step().unwrap();
    }
    let t = data.time();
    assert!((t - 0.5).abs() < 1e-12);
    assert!((data.qpos()[2] - (2.0 - 0.5 * 9.81 * t * t)).abs() < 1e-12);
    assert_eq!(data.contacts().len(), 0);
    for _ in 0..2500 {
        data.step().unwrap();
    }
    let contact = data.contacts().next().unwrap();
    let floor: GeomId = data.model().find("floor").unwrap();
    assert!(contact.geoms().contains(&floor) && contact.is_active());
    assert!((contact.normal()[2].abs() - 1.0).abs() < 1e-12);
    assert!(contact.position()[2].abs() < 0.01 && contact.distance().abs() < 0.01);
    assert!(data.qvel()[2].abs() < 1e-3);
    assert_eq!(data.warning(WarningKind::ContactFull).count, 0);
}

#[test]
fn a_force_written_to_xfrc_applied_accelerates_the_body() {
    let mut data = Data::new(Model::from_xml(BALL).unwrap()).unwrap();
    let ball: BodyId = data.model().find("ball").unwrap();
    data.xfrc_applied_mut()[6 * ball.index()] = 3.0;
    data.forward().unwrap();
    assert!((data.qacc()[0] - 3.0).abs() < 1e-12 && (data.qacc()[2] + 9.81).abs() < 1e-12);
    data.reset().unwrap();
    assert_eq!((data.xfrc_applied()[6], data.time()), (0.0, 0.0));
}

#[test]
fn divergence_is_an_error_with_quantity_and_time() {
    let mut data = Data::new(Model::from_xml(BALL).unwrap()).unwrap();
    for _ in 0..10 {
        data.step().unwrap();
    }
    for (bad, quantity) in [(f64::NAN, DivergedQuantity::Position), (1e200, DivergedQuantity::Position)] {
        let time = data.time();
        data.qpos_mut()[1] = bad;
        match data.step().unwrap_err() {
            Error::Diverged(divergence) => {
                assert_eq!((divergence.quantity, divergence.index, divergence.time), (quantity, 1, time));
            }
            other => panic!("{other}"),
        }
        data.step().expect("MuJoCo has reset the state");
    }
    data.qvel_mut()[4] = f64::INFINITY;
    assert!(matches!(data.step(), Err(Error::Diverged(d)) if d.quantity == DivergedQuantity::Velocity && d.index == 4));
    data.xfrc_applied_mut()[6] = f64::NAN;
    let error = data.step().unwrap_err();
    assert!(matches!(error, Error::Diverged(d) if d.quantity == DivergedQuantity::Acceleration), "{error}");
    assert!(error.to_string().contains("diverged at t = "));
}

#[test]
fn a_stack_overflow_is_an_error_until_a_reset() {
    // enough for free flight, too little for the contact solver
    let xml = BALL.replace("<worldbody>", "<size nstack='250' njmax='40' nconmax='10'/><worldbody>");
    let mut data = Data::new(Model::from_xml(&xml).unwrap()).unwrap();
    let error = loop {
        match data.step() {
            Ok(()) => assert!(data.time() < 5.0, "the stack was large enough: {}", data.max_stack_used()),
            Err(error) => break error,
        }
    };
    assert!(
        matches!(&error, Error::Raised { call: "mj_step", message } if message.contains("Stack overflow")),
        "{error}"
    );
    assert_eq!(data.step().unwrap_err(), error, "unusable until a reset");
    assert_eq!(data.forward().unwrap_err(), error);
    data.reset().unwrap();
    data.step().unwrap();
    assert!(data.time() > 0.0);
}

#[test]
fn a_guarded_error_is_a_rust_error_with_mujocos_message() {
    let error = mujoco_rs::testing::raise("raised on purpose", true).unwrap_err();
    assert_eq!(error, Error::Raised { call: "mju_error", message: "raised on purpose".into() });
}

/// An unguarded call may have Rust or C++ frames below it, which must not be skipped: the process ends at once,
/// with the message and without waiting for a key.
#[test]
fn an_unguarded_error_ends_the_process_with_its_message() {
    const CHILD: &str = "MUJOCO_RS_TEST_RAISE";
    if std::env::var_os(CHILD).is_some() {
        let _ = mujoco_rs::testing::raise("raised on purpose", false);
        unreachable!("mju_error returned");
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "an_unguarded_error_ends_the_process_with_its_message", "--nocapture"])
        .env(CHILD, "1")
        .output()
        .unwrap();
    assert!(!output.status.success());
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(text.contains("mujoco: fatal error: raised on purpose"), "{text}");
    assert!(!String::from_utf8_lossy(&output.stdout).contains("Press Enter"));
}

#[test]
fn threads_that_share_a_model_compute_bit_identical_trajectories() {
    let model = Arc::new(Model::from_xml(BALL).unwrap());
    let fly = |model: Arc<Model>| {
        let mut data = Data::new(model).unwrap();
        data.qvel_mut().copy_from_slice(&[0.3, -0.2, 1.0, 4.0, -5.0, 6.0]);
        for _ in 0..2000 {
            data.step().unwrap();
        }
        data.qpos().iter().map(|x| x.to_bits()).collect::<Vec<_>>()
    };
    let alone = fly(Arc::clone(&model));
    let threads: Vec<_> = (0..4)
        .map(|_| {
            let model = Arc::clone(&model);
            std::thread::spawn(move || fly(model))
        })
        .collect();
    for thread in threads {
        assert_eq!(thread.join().unwrap(), alone);
    }
}

#[test]
fn rays_hit_the_nearest_visible_geom() {
    let mut data = Data::new(Model::from_xml(BALL).unwrap()).unwrap();
    data.forward().unwrap();
    let (ball, floor): (GeomId, GeomId) = (data.model().find("ball").unwrap(), data.model().find("floor").unwrap());
    let body: BodyId = data.model().find("ball").unwrap();
    let down = |exclude| data.ray([0.0, 0.0, 5.0], [0.0, 0.0, -1.0], [true; 6], exclude).unwrap();
    let (hit, distance) = down(None).unwrap();
    assert!(hit == ball && (distance - 2.9).abs() < 1e-12);
    let (hit, distance) = down(Some(body)).unwrap();
    assert!(hit == floor && (distance - 5.0).abs() < 1e-12);
    assert_eq!(data.ray([0.0, 0.0, 5.0], [0.0, 0.0, 1.0], [true; 6], None).unwrap(), None);
    assert!(data.ray([0.0; 3], [0.0; 3], [true; 6], None).is_err());
    assert!(data.ray([f64::NAN, 0.0, 0.0], [1.0, 0.0, 0.0], [true; 6], None).is_err());
}

/// Regression: MuJoCo's compiler does not restore its error handler when an exception passes through it; the
/// handler then jumps into a frame that no longer exists.
#[test]
fn errors_after_an_exception_in_the_compiler_are_errors() {
    // a file name of two letters makes MuJoCo throw std::out_of_range
    for asset in [
        "<mesh name='m' file='ab'/>",
        "<texture name='t' type='2d' file='ab'/>",
        "<hfield name='h' file='ab' size='1 1 1 1'/>",
    ] {
        let xml = format!("<mujoco><asset>{asset}</asset></mujoco>");
        // SAFETY: MuJoCo throws before it opens a file.
        #[allow(unsafe_code)]
        let loaded = unsafe { mujoco_rs::testing::load_unchecked(&xml) };
        assert!(loaded.is_err(), "{xml}");
        let error = mujoco_rs::testing::raise("raised afterwards", true).unwrap_err();
        assert_eq!(error, Error::Raised { call: "mju_error", message: "raised afterwards".into() });
    }
    let xml = BALL.replace("<worldbody>", "<size nstack='250' njmax='40' nconmax='10'/><worldbody>");
    let mut data = Data::new(Model::from_xml(&xml).unwrap()).unwrap();
    data.qpos_mut()[2] = 0.09;
    assert!(matches!(data.step(), Err(Error::Raised { .. })), "a guarded step, too");
}

#[test]
fn invalid_positions_are_errors_of_a_forward_pass() {
    let mut data = Data::new(Model::from_xml(BALL).unwrap()).unwrap();
    for bad in [f64::NAN, f64::INFINITY, -2e10] {
        data.qpos_mut()[1] = bad;
        for result in [data.forward(), data.kinematics()] {
            assert!(matches!(result, Err(Error::Diverged(d)) if d.index == 1), "{bad}: {result:?}");
        }
    }
    data.qpos_mut()[1] = 0.0;
    data.forward().unwrap();
    let xml = "<mujoco><worldbody><body mocap='true'><geom size='.1'/></body></worldbody></mujoco>";
    let mut data = Data::new(Model::from_xml(xml).unwrap()).unwrap();
    data.mocap_pos_mut()[2] = f64::NAN;
    assert!(matches!(data.step(), Err(Error::Value { .. })));
    assert!(matches!(data.forward(), Err(Error::Value { .. })));
    data.mocap_pos_mut()[2] = 1.0;
    data.step().unwrap();
}

#[test]
fn a_thread_with_too_little_stack_for_mujoco_gets_an_error() {
    let model = Arc::new(Model::from_xml(BALL).unwrap());
    let step = |kib: usize| {
        let model = Arc::clone(&model);
        std::thread::Builder::new()
            .stack_size(kib << 10)
            .spawn(move || Data::new(model).and_then(|mut data| data.step().and_then(|()| data.step())))
            .unwrap()
            .join()
            .unwrap()
    };
    match step(64) {
        Err(Error::Raised { message, .. }) => assert!(message.contains("KiB of stack"), "{message}"),
        other => panic!("{other:?}"),
    }
    step(512).unwrap();
    let load = |kib: usize| {
        let loader = std::thread::Builder::new().stack_size(kib << 10);
        loader.spawn(|| Model::from_xml(BALL).map(|model| model.nbody())).unwrap().join().unwrap()
    };
    assert!(load(256).unwrap_err().to_string().contains("KiB of stack"));
    assert_eq!(load(2048).unwrap(), 2);
}

/// Runs in a child process, because `rand()` and the handlers belong to the process.
#[test]
fn random_numbers_and_handlers_of_a_host_program_are_preserved() {
    const CHILD: &str = "MUJOCO_RS_TEST_HOST";
    if std::env::var_os(CHILD).is_some() {
        mujoco_rs::testing::assert_host_is_left_alone(|| {
            let mut data = Data::new(Model::from_xml(BALL).unwrap()).unwrap();
            data.step().unwrap();
            assert!(Model::from_xml("<mujoco><worldbody><geom/></worldbody></mujoco>").is_err());
        });
        return;
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "random_numbers_and_handlers_of_a_host_program_are_preserved", "--nocapture"])
        .env(CHILD, "1")
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// A step of RK4 has four stages; an impact may begin and end within one step.
#[test]
fn a_step_that_brakes_a_body_reports_a_contact() {
    let xml = "<mujoco><option timestep='.004' integrator='RK4'/><worldbody><geom type='plane' size='1 1 1'/>
        <body pos='0 0 1'><freejoint/><geom type='cylinder' size='.06 .015' mass='.027'/></body></worldbody></mujoco>";
    let mut data = Data::new(Model::from_xml(xml).unwrap()).unwrap();
    let (mut braked, mut missed_by_the_last_stage) = (0, 0);
    for start in 0..400 {
        data.reset().unwrap();
        let mut qpos = data.qpos().to_vec();
        let (sin, cos) = (0.02 * f64::from(start)).sin_cos();
        qpos[2..7].copy_from_slice(&[0.07 + 1e-4 * f64::from(start), cos, sin, 0.0, 0.0]);
        data.qpos_mut().copy_from_slice(&qpos);
        data.qvel_mut()[2..].copy_from_slice(&[-0.1 - 0.005 * f64::from(start), 60.0 * sin, 60.0 * cos, 0.0]);
        for _ in 0..20 {
            let (height, before) = (data.qpos()[2], data.qvel()[2]);
            data.step().unwrap();
            let free = (data.qvel()[2] - (before - 9.81 * 0.004)).abs() < 1e-9;
            let contacts = data.contacts_in_step().len();
            assert!(free || contacts > 0, "from {height} m at {before} m/s");
            let reach = 0.004 * (before.abs() + 6.0) + 1e-3;
            assert!(contacts == 0 || height < 0.062 + reach, "from {height} m at {before} m/s");
            braked += usize::from(!free);
            missed_by_the_last_stage += usize::from(!free && data.contacts().len() == 0);
        }
    }
    assert!(braked > 400 && missed_by_the_last_stage > 0, "{braked} and {missed_by_the_last_stage}");
    data.forward().unwrap();
    assert_eq!(data.contacts_in_step().len(), data.contacts().len());
}
