"""The trials: what was tried, what happened then, what happens now, and the tests of it.

Sources are public reports of users of similar software, a newcomer's trial with her own arm and camera, and an attack
on every reader.
"""

from __future__ import annotations

from dataclasses import dataclass

BASE_COMMIT = "8b1c098"  # at which everything was tried first


@dataclass(frozen=True)
class Trial:
    """One line of the table.

    Attributes:
        id: letter of the kind and number: A wrong answers that look right, B crashes, C trust, D importers.
        tried: the input.
        before: what happened at ``BASE_COMMIT``.
        now: what happens now.
        tests: their files below ``tests``, each with its function; empty if no test can show it in seconds.
        is_partial: whether what happens now is less than what was asked for.
    """

    id: str
    tried: str
    before: str
    now: str
    tests: tuple[str, ...] = ()
    is_partial: bool = False


FITS, SEARCHES = "identification/test_reported_fits.py", "identification/test_convergence.py"
MISFIT, CHECKS = "identification/test_misfit.py", "inspection/test_corrections.py"
INSPECT, PATCHES = "inspection/test_inspect.py", "inspection/test_patch_noise.py"
URDF, LAYER, DROP_IN = "robots/test_urdf_file.py", "layer/test_cloth.py", "layer/test_drop_in.py"
MISSING, REFUSED = "recordings/test_missing_data.py", "recordings/test_refusals.py"
IMPORTS, ROS = "recordings/formats/test_import_refusals.py", "recordings/formats/test_ros_habits.py"
TOWEL = "training/test_towel.py"
TOWEL_HOLDS_TRUTH = "test_a_number_of_the_towel_holds_the_truth_or_is_not_identifiable"
TOWEL_NAMES_GRIP = "test_the_grip_or_the_first_shape_of_the_towel_is_the_likeliest_reason"
LIBRARY, CLI, FIT = "engine/test_library.py", "test_cli.py", "training/test_fit.py"

TRIALS = (
    Trial(
        "A1",
        "fit without a stated noise, clouds stamped 33 ms late",
        "drag 2.09 ± 0.26, identifiable (truth 1.2)",
        "the clock is corrected and its error counts; the intervals hold the truth; misfit that lasts widens them",
        (
            f"{FITS}::test_clouds_with_late_stamps_and_no_stated_noise",
            f"{MISFIT}::test_errors_that_follow_the_cloth_are_covered",
            f"{PATCHES}::test_the_checks_before_a_fit_name_it",
        ),
    ),
    Trial(
        "A2",
        "left and right grippers exchanged",
        "E 3.0 times the truth, identifiable",
        "refused, with the names to exchange",
        (f"{MISFIT}::test_grippers_that_are_exchanged_are_refused",),
    ),
    Trial(
        "A3",
        "towel on a bar held as a hinge, stereo camera, first shape from depth",
        "E h 249 ± 45 N/m (truth 800), converged",
        "drag is identifiable and its interval holds the truth, nothing else is; with `--exact-bench` nothing is, and "
        "the grip is named as the likeliest reason (`studies honesty --towel`)",
        (f"{TOWEL}::{TOWEL_HOLDS_TRUTH}", f"{TOWEL}::{TOWEL_NAMES_GRIP}"),
    ),
    Trial(
        "A4",
        "the towel by one corner; search cut short, end worse than the start",
        "133 ± 13 N/m, identifiable (truth 800)",
        "nothing is identifiable where the search stops more than a few standard errors before its end; with "
        "`--exact-bench` the towel's grip is named as the likeliest reason",
        (
            f"{TOWEL}::{TOWEL_HOLDS_TRUTH}",
            f"{TOWEL}::{TOWEL_NAMES_GRIP}",
            f"{SEARCHES}::test_a_search_cut_short_far_off_says_nothing",
            f"{SEARCHES}::test_a_search_cut_short_near_the_optimum_says_nothing_either",
        ),
    ),
    Trial(
        "A5",
        "lag of 50 ms",
        "`inspect` names it, `identify` says nothing: E 0.35 of the truth",
        "`identify` runs the checks of `inspect`, corrects the clock and fits its error",
        (
            f"{FITS}::test_clouds_with_late_stamps_and_no_stated_noise",
            f"{CHECKS}::test_a_clock_that_is_off_is_set_within_its_error",
        ),
    ),
    Trial(
        "A6",
        "a camera that froze: clouds equal bit for bit",
        "no word, E 5.6 % low",
        "named, and left out of a fit",
        (
            f"{CHECKS}::test_frozen_clouds_are_left_out_and_named",
            f"{MISFIT}::test_frozen_clouds_are_left_out_of_a_fit_unless_checks_are_off",
        ),
    ),
    Trial(
        "A7",
        "path of a hand that rests for 1 s, given by the rest's two ends, and then moves at 0.5 m/s",
        "the interpolated hand swings 73 mm backwards during the rest",
        "the hand rests: between given points that are 0.12 s or more apart, the path stays between the two",
        ("physics/test_motion.py::test_a_hand_whose_rest_has_two_knots_rests",),
    ),
    Trial(
        "A8",
        "URDF of two arms whose joints have the same names",
        "the left arm stands on the right arm's base, 0.8 m off",
        "refused: names must differ",
        (f"{URDF}::test_two_arms_whose_joints_have_the_same_names",),
    ),
    Trial(
        "A9",
        "`RestShape` with a skew of +0.03, on a mesh that lists the corners of its triangles clockwise",
        "a fit finds -0.0300",
        "clockwise or not, the rest shape is the same",
        ("physics/test_rest_shape.py::test_the_true_shape_does_not_depend_on_the_winding",),
    ),
    Trial(
        "A10",
        "`points.npz` is a link to nothing",
        "read as not recorded",
        "refused: fetch the data",
        (f"{MISSING}::test_a_link_to_nothing_is_no_absent_stream",),
    ),
    Trial(
        "A11",
        "`AEP(5e4, 0.3, 1e-3)`",
        "the third argument is the contact stiffness; layers pass through each other",
        "keyword-only; a contact too weak to carry the cloth is warned of",
        ("physics/test_contact.py::test_layers_too_weak_to_carry_the_cloth_are_told",),
    ),
    Trial(
        "A12",
        "`arm(q.bfloat16())`",
        "up to 10.5 mm off, silent",
        "refused, as every input in half precision",
        (
            "robots/test_motion.py::test_refuses_joints_that_are_rounded_by_millimetres",
            f"{LAYER}::test_inputs_in_half_precision_are_refused",
        ),
    ),
    Trial(
        "A13",
        "a field's checkpoint into a scalar, torch 2.5 to 2.9",
        "loads the first triangle's value",
        "refused",
        ("test_parameters.py::test_a_checkpoint_of_another_shape_is_refused",),
    ),
    Trial(
        "A14",
        "OBJ with a face of two corners",
        "dropped silently",
        "refused with the line",
        (
            "meshes/test_obj.py::test_damage_is_named",
            "meshes/test_mesh.py::test_load_names_a_face_of_fewer_than_three_corners",
        ),
    ),
    Trial(
        "A15",
        "report of `diagnose`: the motion in which a cause is most significant",
        "a motion that the model with the cause predicts no better, if the motion is left out of the fit",
        "one that it predicts better, if there is any",
        ("diagnosis/test_localisation.py::test_it_shows_in_a_motion_that_gains_held_out",),
    ),
    Trial(
        "A16",
        "`Adam(cloth.parameters())`",
        "learns gravity, its tilt and the wind",
        "facts about the world require no gradients unless asked",
        (f"{DROP_IN}::test_an_optimiser_of_all_parameters_leaves_the_world_alone",),
    ),
    Trial(
        "A17",
        "TUM folder with depth in millimetres",
        "1.0 m read as 0.2 m, silent",
        "refused until `depth_scale` is stated; `convert` prints unit and median depth",
        (f"{IMPORTS}::test_tum_depth_in_millimetres_is_not_read_as_a_fifth",),
    ),
    Trial(
        "A18",
        "gripper that is never closed",
        "falling cloth is fitted for minutes",
        "refused: nothing holds the cloth",
        ("identification/test_observed_episodes.py::test_a_fit_needs_something_that_holds_the_cloth",),
    ),
    Trial(
        "A19",
        "default contact on a sheet of 200 triangles",
        "layers 47.8 mm apart, step 3.2 times shorter, no word",
        "off, and `print(cloth)` says so",
        ("physics/test_contact.py::test_contact_that_cannot_act_is_off_by_default",),
    ),
    Trial(
        "A20",
        "start 10 times too stiff",
        "E 0.927 ± 0.019 of the truth, identifiable",
        "the interval holds the truth",
        (f"{FITS}::test_a_start_one_or_two_decades_off",),
    ),
    Trial(
        "B1",
        "the README's episode, fitted to its points alone: `identify --use points`",
        "TypeError while the progress is stored",
        "works: the progress is stored, and `--resume` reads it",
        ("identification/test_resume_store.py::test_distances_of_one_kind_of_data_are_stored",),
    ),
    Trial(
        "B2",
        "torch 2.4.1, as declared",
        "AttributeError at import",
        "2.10 is declared; the job `lowest-torch` of CI runs all tests with the declared minimum",
        ("validation/trials/test_trials.py::test_the_lowest_torch_is_tested",),
    ),
    Trial(
        "B3",
        "`DistributedDataParallel(cloth)` without contact, second step",
        "unused parameters",
        "works, with both engines",
        (f"{DROP_IN}::test_data_parallel_training_waits_for_no_parameter_that_cannot_act",),
    ),
    Trial(
        "B4",
        "`(ulimit -f 8; torchcloth identify ...)`",
        "RuntimeError of torch.save",
        "one line, exit code 2, says how to resume",
        (
            f"{CLI}::test_a_full_disk_is_one_line_that_says_how_to_resume",
            "test_files.py::test_a_disk_that_is_full_is_an_error_of_the_system",
        ),
    ),
    Trial(
        "B5",
        'URDF solids of size 0; `rpy="0 0 inf"`',
        "AttributeError; bare ValueError",
        "one line, exit code 2",
        (f"{URDF}::test_a_solid_without_a_size", f"{URDF}::test_a_number_that_is_not_finite"),
    ),
    Trial(
        "B6",
        "points.npz of 1.3 MB that unpacks to 3.2 GB",
        "accepted, or MemoryError",
        "refused by the declared size; parts of bags by what they unpack to",
        ("test_unpacking.py::test_an_episode", "recordings/formats/test_hostile_files.py::*"),
    ),
    Trial(
        "B7",
        "engine library in the cache cut short",
        "SIGBUS at every start",
        "built anew",
        (f"{LIBRARY}::test_half_a_library_is_built_anew",),
    ),
    Trial(
        "B8",
        "`identify ... >&-`; `inspect \\| head`",
        "AttributeError; exit code 1",
        "no error; 141 as other tools",
        (
            f"{CLI}::test_a_stream_that_is_closed_is_no_failure",
            f"{CLI}::test_a_reader_that_closes_the_pipe_is_no_failure",
        ),
    ),
    Trial(
        "C1",
        "checkpoint whose config names `os.system` as network",
        "executed",
        "nothing but a subclass of `nn.Module` that is imported or passed",
        (
            f"{FIT}::test_nothing_but_a_module_class_is_called",
            f"{FIT}::test_a_checkpoint_with_objects_is_refused",
            "training/test_fit_refusals.py::test_a_config_runs_no_code",
        ),
    ),
    Trial(
        "C2",
        "engine cache that others can write to, or that a link replaces",
        "loaded",
        "owner and mode of every folder on the real path are checked; links are not followed",
        (
            f"{LIBRARY}::test_what_others_could_write_or_exchange_is_not_loaded",
            f"{LIBRARY}::test_links_are_not_followed",
            f"{LIBRARY}::test_somebody_elses_library_in_the_temporary_folder_is_not_loaded",
        ),
    ),
    Trial(
        "C3",
        "terminal escape sequences in names",
        "printed raw",
        "refused as names, escaped in messages of bounded length",
        ("test_errors.py::*",),
    ),
    Trial(
        "C4",
        "lxml without a lower bound",
        "old versions resolve entities",
        "lxml 5 or newer; external entities are never resolved",
        (
            f"{URDF}::test_an_lxml_that_resolves_entities_of_files_cannot_be_installed",
            f"{URDF}::test_a_urdf_reads_no_other_file",
        ),
    ),
    Trial(
        "D1",
        "a ROS message twice; two stamps out of order",
        "refused",
        "used once, sorted by stamps, with a note",
        (
            f"{ROS}::test_a_message_that_was_recorded_twice_counts_once",
            f"{ROS}::test_messages_out_of_order_are_sorted_by_their_stamps",
        ),
    ),
    Trial(
        "D2",
        "arm and finger in messages of their own",
        "refused",
        "the finger's width is interpolated",
        (f"{ROS}::test_a_finger_in_messages_of_its_own",),
    ),
    Trial(
        "D3",
        "rosbag2 folder without metadata.yaml",
        "refused",
        "the only storage file is read, with a note; of several, refused with the command that reindexes",
        (f"{ROS}::test_a_bag_folder_without_its_metadata",),
    ),
    Trial(
        "D4",
        "ROS 1 `.bag`",
        "refused",
        "read",
        (f"{ROS}::test_a_ros1_bag", f"{ROS}::test_a_ros1_bag_without_its_index"),
    ),
    Trial(
        "D5",
        "depth-only TUM or Redwood folder; `.pcd` clouds with a CSV of stamps",
        "refused without a reason",
        "not read: refused with the part that is missing, or with the page on building the episode in Python",
        (
            f"{IMPORTS}::test_a_folder_that_lacks_a_part_says_which",
            f"{IMPORTS}::test_a_folder_of_point_clouds_says_what_to_do",
        ),
        is_partial=True,
    ),
    Trial(
        "D6",
        "points at (0, 0, 0) for no reading",
        "used as points",
        "left out of ROS bags; `inspect` names them elsewhere",
        (f"{ROS}::test_points_at_the_lens_are_no_readings", f"{INSPECT}::test_points_without_a_reading_are_named"),
    ),
    Trial(
        "D7",
        "LeRobot with the hardware's times",
        "refused",
        "read",
        (f"{IMPORTS}::test_lerobot_times_of_the_hardware_are_read",),
    ),
    Trial(
        "D8",
        "UTF-8 with a byte order mark",
        "refused",
        "read",
        (
            f"{IMPORTS}::test_files_with_a_byte_order_mark_are_read",
            "recordings/test_roundtrip.py::test_files_with_a_byte_order_mark_are_read",
        ),
    ),
    Trial(
        "D9",
        "K of another resolution, normalised, or with fx and cx exchanged",
        "accepted",
        "refused by every reader",
        (f"{IMPORTS}::test_a_camera_matrix_of_other_images",),
    ),
    Trial(
        "D10",
        "epoch stamps in milliseconds",
        "another reason",
        "looks like milliseconds",
        (f"{IMPORTS}::test_times_in_milliseconds_since_1970",),
    ),
    Trial(
        "D11",
        "relative URDF path in an episode that is copied",
        "the copy has no URDF",
        "the URDF and meshes below its folder are copied",
        (
            f"{IMPORTS}::test_a_urdf_beside_the_scene_goes_into_the_episode",
            "recordings/test_roundtrip.py::test_a_urdf_beside_the_episode_is_copied_with_it",
        ),
    ),
    Trial(
        "D12",
        "an arm without solids in view of a depth camera",
        "the arm becomes cloth, no word",
        "a note",
        (f"{INSPECT}::test_an_arm_without_solids_in_view_is_a_note",),
    ),
    Trial(
        "D13",
        "frames that lose most of the cloth",
        "used",
        "counted as rejected",
        (f"{INSPECT}::test_frames_that_lose_most_of_the_cloth_are_rejected",),
    ),
    Trial(
        "D14",
        "initial_vertices in another order than the mesh's",
        "accepted",
        "refused, with the ratio of edges",
        (f"{REFUSED}::test_initial_vertices_in_another_order",),
    ),
    Trial(
        "D15",
        "one triangle 2000 times flatter than the others",
        "a step 2000 times shorter, no word",
        "named, with what it costs",
        ("meshes/test_mesh.py::test_a_triangle_that_is_much_flatter_than_the_others_is_named",),
    ),
    Trial(
        "D16",
        "limits 0 to 0 or in degrees, xacro not expanded, MJCF as URDF",
        "accepted, or a traceback",
        "a warning; refused with what it is",
        (f"{URDF}::test_strange_limits_are_named", f"{URDF}::test_a_model_of_another_kind"),
    ),
)
