//! Writes a robot's description as MJCF, MuJoCo's XML format.

use std::fmt::Write;

use super::inertia;
use super::robot::{Body, Geom, Integrator, Joint, JointKind, Robot, Shape};

/// Formats numbers for MJCF. Rust prints the shortest text that parses to the same number.
fn list(numbers: &[f64]) -> String {
    let texts: Vec<String> = numbers.iter().map(f64::to_string).collect();
    texts.join(" ")
}

/// The MJCF of `robot`, self-contained: local coordinates, radians, explicit inertias, no visuals.
pub fn write(robot: &Robot) -> String {
    let mut xml = String::new();
    let integrator = match robot.integrator {
        Integrator::Euler => "Euler",
        Integrator::Rk4 => "RK4",
    };
    line(&mut xml, 0, &format!("<mujoco model=\"{}\">", robot.name));
    line(&mut xml, 1, "<compiler angle=\"radian\" autolimits=\"false\"/>");
    line(
        &mut xml,
        1,
        &format!(
            "<option integrator=\"{integrator}\" timestep=\"{}\" gravity=\"0 0 {}\"/>",
            robot.timestep, robot.gravity
        ),
    );
    line(&mut xml, 1, "<worldbody>");
    line(&mut xml, 2, &format!("<geom name=\"floor\" type=\"plane\" size=\"40 40 40\"{}/>", contact(robot, None)));
    write_body(&mut xml, 2, robot, &robot.torso, inertia::scale(robot));
    line(&mut xml, 1, "</worldbody>");
    line(&mut xml, 1, "<actuator>");
    for motor in &robot.motors {
        let joint = &motor.joint;
        line(
            &mut xml,
            2,
            &format!(
                "<motor name=\"{joint}\" joint=\"{joint}\" gear=\"{}\" ctrllimited=\"true\" ctrlrange=\"-1 1\"/>",
                motor.gear
            ),
        );
    }
    line(&mut xml, 1, "</actuator>");
    line(&mut xml, 0, "</mujoco>");
    xml
}

fn line(xml: &mut String, depth: usize, text: &str) {
    writeln!(xml, "{:indent$}{text}", "", indent = 2 * depth).expect("writing to a string");
}

/// The contact attributes of a geom of the robot, or of the floor.
fn contact(robot: &Robot, geom: Option<&Geom>) -> String {
    let contact = &robot.contact;
    let on_robot = geom.is_some();
    let [mut sliding, torsional, rolling] = contact.friction;
    if let Some(own) = geom.and_then(|g| g.sliding_friction) {
        sliding = own;
    }
    // Two geoms can touch if the contype of one and the conaffinity of the other share a bit.
    let affinity = if on_robot { u32::from(contact.between_bodies) } else { 1 };
    let condim = if on_robot { contact.condim } else { 3 };
    let mut out = format!(
        " contype=\"1\" conaffinity=\"{affinity}\" condim=\"{condim}\" friction=\"{}\"",
        list(&[sliding, torsional, rolling])
    );
    if contact.margin > 0.0 {
        // MuJoCo up to 3.4 used the larger margin of two geoms, later versions add both. Every geom has the same
        // margin, so half of it gives the original contact distance.
        write!(out, " margin=\"{}\"", contact.margin / 2.0).expect("writing to a string");
    }
    if let Some((solimp, solref)) = contact.solver {
        write!(out, " solimp=\"{}\" solref=\"{}\"", list(&solimp), list(&solref)).expect("writing to a string");
    }
    out
}

fn write_body(xml: &mut String, depth: usize, robot: &Robot, body: &Body, scale: f64) {
    line(xml, depth, &format!("<body name=\"{}\" pos=\"{}\">", body.name, list(&body.position)));
    let p = inertia::of_body(body, robot.density);
    let i = p.inertia;
    // Rounding residues are set to zero to keep the text readable.
    let largest = i[0][0].max(i[1][1]).max(i[2][2]);
    let clean = |x: f64| if x.abs() < 1e-15 * largest { 0.0 } else { x * scale };
    let full = [i[0][0], i[1][1], i[2][2], i[0][1], i[0][2], i[1][2]].map(clean);
    line(
        xml,
        depth + 1,
        &format!("<inertial pos=\"{}\" mass=\"{}\" fullinertia=\"{}\"/>", list(&p.centre), p.mass * scale, list(&full)),
    );
    for joint in &body.joints {
        line(xml, depth + 1, &joint_text(robot, joint));
    }
    for geom in &body.geoms {
        line(xml, depth + 1, &geom_text(robot, geom));
    }
    for child in &body.children {
        write_body(xml, depth + 1, robot, child, scale);
    }
    line(xml, depth, "</body>");
}

fn joint_text(robot: &Robot, joint: &Joint) -> String {
    let kind = match joint.kind {
        JointKind::Free => return format!("<joint name=\"{}\" type=\"free\" limited=\"false\"/>", joint.name),
        JointKind::Slide => "slide",
        JointKind::Hinge => "hinge",
    };
    let mut out = format!(
        "<joint name=\"{}\" type=\"{kind}\" axis=\"{}\" pos=\"{}\" ref=\"{}\" armature=\"{}\" damping=\"{}\" \
         stiffness=\"{}\"",
        joint.name,
        list(&joint.axis),
        list(&joint.position),
        joint.reference,
        joint.armature,
        joint.damping,
        joint.stiffness
    );
    match joint.range {
        None => out.push_str(" limited=\"false\""),
        Some(range) => write!(out, " limited=\"true\" range=\"{}\"", list(&range)).expect("writing to a string"),
    }
    if let Some((solimp, solref)) = robot.limit_solver {
        let text = format!(" solimplimit=\"{}\" solreflimit=\"{}\"", list(&solimp), list(&solref));
        out.push_str(&text);
    }
    out.push_str("/>");
    out
}

fn geom_text(robot: &Robot, geom: &Geom) -> String {
    let shape = match geom.shape {
        Shape::Sphere => format!("type=\"sphere\" size=\"{}\"", geom.radius),
        Shape::Segment { from, to } => {
            format!("type=\"capsule\" size=\"{}\" fromto=\"{} {}\"", geom.radius, list(&from), list(&to))
        }
        Shape::Tilted { centre, half_length, tilt } => format!(
            "type=\"capsule\" size=\"{} {half_length}\" pos=\"{}\" axisangle=\"0 1 0 {tilt}\"",
            geom.radius,
            list(&centre)
        ),
    };
    format!("<geom name=\"{}\" {shape}{}/>", geom.name, contact(robot, Some(geom)))
}
