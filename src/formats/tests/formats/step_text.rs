//! STEP files written by hand: senses, units, ranges and shells, each with its result by ISO 10303-42.

use std::f64::consts::PI;
use std::path::Path;

use regrind_core::geometry::Point;
use regrind_core::surface::SurfaceChoice;
use regrind_core::surface::parametric::{Face, ParametricSurface};
use regrind_formats::{CadModel, ChoiceError, FormatError, parse_cad};

/// Contexts #900 (mm, degrees) and #910 (inch, radians).
const CONTEXTS: &str = "\
#900=(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNIT_ASSIGNED_CONTEXT((#901,#902))REPRESENTATION_CONTEXT('',''));
#901=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.));
#902=(CONVERSION_BASED_UNIT('DEGREE',#903)NAMED_UNIT(*)PLANE_ANGLE_UNIT());
#903=PLANE_ANGLE_MEASURE_WITH_UNIT(PLANE_ANGLE_MEASURE(0.017453292519943295),#904);
#904=(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.));
#910=(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNIT_ASSIGNED_CONTEXT((#911,#904))REPRESENTATION_CONTEXT('',''));
#911=(CONVERSION_BASED_UNIT('INCH',#912)LENGTH_UNIT()NAMED_UNIT(*));
#912=LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#901);
";

/// A square of 2 x 2 in the plane z = 0, as the face #30.
const SQUARE: &str = "\
#10=PLANE('',#11);
#11=AXIS2_PLACEMENT_3D('',#12,$,$);
#12=CARTESIAN_POINT('',(0.,0.,0.));
#20=POLY_LOOP('',(#21,#22,#23,#24));
#21=CARTESIAN_POINT('',(-1.,-1.,0.));
#22=CARTESIAN_POINT('',(1.,-1.,0.));
#23=CARTESIAN_POINT('',(1.,1.,0.));
#24=CARTESIAN_POINT('',(-1.,1.,0.));
#25=FACE_OUTER_BOUND('',#20,.T.);
#30=ADVANCED_FACE('',(#25),#10,.T.);
";

fn parse(entities: &str) -> Result<CadModel, FormatError> {
    // A surface without a context needs one unit of length in the file.
    let contexts = CONTEXTS.split_inclusive('\n').filter(|line| entities.contains("#910)") || !line.starts_with("#91"));
    let contexts: String = contexts.collect();
    let text = format!("ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n{contexts}{entities}ENDSEC;\nEND-ISO-10303-21;\n");
    parse_cad(Path::new("hand.stp"), text.as_bytes())
}

fn faces(entities: &str) -> Vec<Face> {
    parse(entities).unwrap().faces.into_iter().map(|face| face.face.unwrap()).collect()
}

fn only(entities: &str) -> Face {
    let [face] = faces(entities).try_into().unwrap();
    face
}

#[test]
fn outside_of_shells_and_faces() {
    let outside = |entities: &str| {
        only(&format!("{SQUARE}{entities}#50=SHAPE_REPRESENTATION('',(#40),#900);\n")).normal_points_out
    };
    assert_eq!(outside("#40=MANIFOLD_SOLID_BREP('',#41);\n#41=CLOSED_SHELL('',(#30));\n"), Some(true));
    // The inner shell of a hollow solid has the material on its other side.
    let hollow = "#40=BREP_WITH_VOIDS('',#41,(#43));\n#41=CLOSED_SHELL('',());\n#42=CLOSED_SHELL('',(#30));\n";
    assert_eq!(outside(&format!("{hollow}#43=ORIENTED_CLOSED_SHELL('',*,#42,.F.);\n")), Some(false));
    assert_eq!(outside(&format!("{hollow}#43=ORIENTED_CLOSED_SHELL('',*,#42,.T.);\n")), Some(true));
    let turned = "#40=MANIFOLD_SOLID_BREP('',#41);\n#41=CLOSED_SHELL('',(#44));\n#44=ORIENTED_FACE('',*,#30,.F.);\n";
    assert_eq!(outside(turned), Some(false));
    // An open shell has no material.
    assert_eq!(outside("#40=SHELL_BASED_SURFACE_MODEL('',(#41));\n#41=OPEN_SHELL('',(#30));\n"), None);
    assert_eq!(outside("#40=SHELL_BASED_SURFACE_MODEL('',(#41));\n#41=CLOSED_SHELL('',(#30));\n"), Some(true));
}

#[test]
fn senses_of_trimmed_surface_turn_its_normal() {
    let outside = |senses: &str| {
        let trimmed = format!("#15=RECTANGULAR_TRIMMED_SURFACE('',#10,-2.,2.,-2.,2.,{senses});\n");
        let face = SQUARE.replace("(#25),#10,", "(#25),#15,");
        let solid = "#40=MANIFOLD_SOLID_BREP('',#41);\n#41=CLOSED_SHELL('',(#30));\n";
        only(&format!("{face}{trimmed}{solid}#50=SHAPE_REPRESENTATION('',(#40),#900);\n")).normal_points_out
    };
    assert_eq!(outside(".T.,.T."), Some(true));
    assert_eq!(outside(".F.,.T."), Some(false));
    assert_eq!(outside(".T.,.F."), Some(false));
    assert_eq!(outside(".F.,.F."), Some(true));
}

/// A range over the place where the parameter begins is the short way, in the unit of angle of the file.
#[test]
fn range_goes_on_where_parameter_repeats() {
    let cylinder = "#10=CYLINDRICAL_SURFACE('',#11,10.);\n#11=AXIS2_PLACEMENT_3D('',#12,$,$);\n\
                    #12=CARTESIAN_POINT('',(0.,0.,0.));\n#50=SHAPE_REPRESENTATION('',(#15),#900);\n";
    let area = |range: &str| only(&format!("{cylinder}#15=RECTANGULAR_TRIMMED_SURFACE('',#10,{range});\n")).area_mm2();
    let near = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 0.02, "{found}, {expected}");
    let strip = |degrees: f64| 10.0 * degrees * PI / 180.0 * 5.0;
    near(area("-10.,10.,0.,5.,.T.,.T."), strip(20.0));
    near(area("350.,10.,0.,5.,.T.,.T."), strip(20.0));
    near(area("10.,350.,0.,5.,.T.,.T."), strip(340.0));
    near(area("10.,350.,5.,0.,.F.,.F."), strip(20.0));
    near(area("350.,10.,5.,0.,.F.,.F."), strip(340.0));
    // The same over the profile of an extrusion, whose parameter is an angle too.
    let extrusion = "#10=SURFACE_OF_LINEAR_EXTRUSION('',#13,#14);\n#13=CIRCLE('',#11,10.);\n#14=VECTOR('',#16,1.);\n\
                     #16=DIRECTION('',(0.,0.,1.));\n#11=AXIS2_PLACEMENT_3D('',#12,$,$);\n\
                     #12=CARTESIAN_POINT('',(0.,0.,0.));\n#50=SHAPE_REPRESENTATION('',(#15),#900);\n";
    let area = |range: &str| only(&format!("{extrusion}#15=RECTANGULAR_TRIMMED_SURFACE('',#10,{range});\n")).area_mm2();
    near(area("350.,10.,0.,5.,.T.,.T."), strip(20.0));
    near(area("0.,90.,0.,5.,.T.,.T."), strip(90.0));
}

/// A trimmed curve whose sense is false has the opposite parameter, and a surface made of it the opposite normal.
#[test]
fn sense_of_trimmed_profile_turns_normal() {
    let normal = |ends: &str| {
        let entities = format!(
            "#10=SURFACE_OF_LINEAR_EXTRUSION('',#13,#14);\n#13=TRIMMED_CURVE('',#17,{ends},.PARAMETER.);\n\
             #17=CIRCLE('',#11,10.);\n#14=VECTOR('',#16,1.);\n#16=DIRECTION('',(0.,0.,1.));\n\
             #11=AXIS2_PLACEMENT_3D('',#12,$,$);\n#12=CARTESIAN_POINT('',(0.,0.,0.));\n\
             #15=RECTANGULAR_TRIMMED_SURFACE('',#10,{},0.,5.,.T.,.T.);\n#50=SHAPE_REPRESENTATION('',(#15),#900);\n",
            if ends.contains(".F.") { "-20.,-10." } else { "10.,20." }
        );
        let face = only(&entities);
        let u: f64 = if ends.contains(".F.") { -15.0 } else { 15.0 };
        let found = face.surface.evaluate(u.to_radians(), 1.0);
        let at = 15f64.to_radians();
        assert!((found.point - Point::new(10.0 * at.cos(), 10.0 * at.sin(), 1.0)).norm() < 1e-12);
        found.area_vector().normalize().dot(&found.point.coords.xy().push(0.0).normalize())
    };
    assert!((normal("(PARAMETER_VALUE(10.)),(PARAMETER_VALUE(20.)),.T.") - 1.0).abs() < 1e-12);
    assert!((normal("(PARAMETER_VALUE(20.)),(PARAMETER_VALUE(10.)),.F.") + 1.0).abs() < 1e-12);
}

#[test]
fn mapped_representation_has_units_of_its_own() {
    let inner = "#40=MANIFOLD_SOLID_BREP('',#41);\n#41=CLOSED_SHELL('',(#30));\n";
    let outer = "#60=REPRESENTATION_MAP(#11,#50);\n#61=MAPPED_ITEM('',#60,#62);\n#62=AXIS2_PLACEMENT_3D('',#63,$,$);\n\
                 #63=CARTESIAN_POINT('',(100.,0.,0.));\n#70=SHAPE_REPRESENTATION('',(#61),#900);\n";
    for (context, side) in [("#900", 2.0), ("#910", 50.8)] {
        let source = format!("#50=SHAPE_REPRESENTATION('',(#40),{context});\n");
        let [low, high] = only(&format!("{SQUARE}{inner}{source}{outer}")).bounds();
        assert!((high.x - low.x - side).abs() < 1e-12 && (0.5 * (high.x + low.x) - 100.0).abs() < 1e-12, "{context}");
    }
}

/// Without a reference direction, x of a placement is the part of the x axis that is perpendicular to z.
#[test]
fn placement_without_reference_has_x_of_file() {
    for (z, x) in [("0.95,0.,0.3122498999199199", [0.3122498999199199, 0.0, -0.95]), ("-1.,0.,0.", [0.0, 1.0, 0.0])] {
        let placed = SQUARE.replace("#12,$,$);", "#12,#13,$);");
        let entities = format!(
            "{placed}#13=DIRECTION('',({z}));\n#40=GEOMETRIC_SET('',(#30));\n#50=SHAPE_REPRESENTATION('',(#40),#900);\n"
        );
        let ParametricSurface::Plane { frame } = only(&entities).surface else { panic!("a plane") };
        assert!((frame.axes[0] - nalgebra::Vector3::from(x)).norm() < 1e-12, "{z}");
    }
}

/// The surface of a face that no representation has is not a face with the border of its domain.
#[test]
fn surface_of_lost_face_is_no_bare_surface() {
    let spline = "#80=B_SPLINE_SURFACE_WITH_KNOTS('',1,1,((#21,#24),(#22,#23)),.UNSPECIFIED.,.F.,.F.,.F.,(2,2),(2,2),\
                  (0.,1.),(0.,1.),.UNSPECIFIED.);\n";
    let bare = faces(&format!("{SQUARE}{spline}"));
    assert_eq!((bare.len(), bare[0].outlines.len()), (1, 0));
    let lost = SQUARE.replace("(#25),#10,", "(#25),#80,");
    assert!(matches!(parse(&format!("{lost}{spline}")), Err(FormatError::NoData { .. })));
}

/// Sets that have the set below twice: two to the power of 30 items.
#[test]
fn nested_sets_are_bounded() {
    let mut entities = String::from("#50=SHAPE_REPRESENTATION('',(#200),#900);\n");
    for n in 200..230 {
        entities += &format!("#{n}=GEOMETRIC_SET('',(#{},#{}));\n", n + 1, n + 1);
    }
    entities += "#230=GEOMETRIC_SET('',());\n";
    assert!(matches!(parse(&entities), Err(FormatError::Unexpected { .. })));
}

#[test]
fn largest_face_is_clear_or_none() {
    let two = |size: f64| {
        let second = format!(
            "#120=POLY_LOOP('',(#121,#122,#123,#124));\n#121=CARTESIAN_POINT('',(0.,0.,0.));\n\
             #122=CARTESIAN_POINT('',({size:?},0.,0.));\n#123=CARTESIAN_POINT('',({size:?},2.,0.));\n\
             #124=CARTESIAN_POINT('',(0.,2.,0.));\n#125=FACE_OUTER_BOUND('',#120,.T.);\n\
             #130=ADVANCED_FACE('',(#125),#10,.T.);\n"
        );
        let shell = "#40=OPEN_SHELL('',(#30,#130));\n#50=SHAPE_REPRESENTATION('',(#40),#900);\n";
        format!("{SQUARE}{second}{shell}")
    };
    let choose = |entities: &str, choice: Option<SurfaceChoice>| {
        parse(entities).unwrap().choose(choice.as_ref()).map(|(number, _)| number)
    };
    assert_eq!(choose(&two(3.0), None), Ok(2));
    assert_eq!(choose(&two(1.0), None), Ok(1));
    assert_eq!(choose(&two(2.02), None), Err(ChoiceError::SeveralLargest { numbers: vec![1, 2] }));
    // A face that cannot be read can be the largest; a person may say that it is not.
    let unreadable = two(1.0).replace("(#125),#10,", "(#125),#99,") + "#99=OFFSET_SURFACE('',#10,1.,.F.);\n";
    assert!(matches!(choose(&unreadable, None), Err(ChoiceError::UnknownArea { number: 2, .. })));
    assert_eq!(choose(&unreadable, Some(SurfaceChoice::Largest)), Ok(1));
    assert_eq!(choose(&unreadable, Some(SurfaceChoice::Number(1))), Ok(1));
    let line = two(0.0).replace("(#30,#130)", "(#130)");
    assert_eq!(choose(&line, None), Err(ChoiceError::NoArea));
}
