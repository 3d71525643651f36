"""Entries that nerfbaselines finds through ``nerfbaselines.specs``: the method, the loader, the data sets."""

from __future__ import annotations

from nerfbaselines import register

_MODULE = "gridreg.adapters.nerfbaselines"
register(
    {
        "id": "gridreg",
        "method_class": f"{_MODULE}:GridregMethod",
        "conda": {
            "environment_name": "gridreg",
            "python_version": "3.11",
            "install_script": "pip install gridreg[train]",
        },
        "metadata": {
            "name": "gridreg",
            "description": "TensoRF with regularizers for few views: visual hull, total variation, occlusion loss.",
        },
        "presets": {},
        "implementation_status": {},
    }
)
register({"id": "gridreg-fewview", "load_dataset_function": f"{_MODULE}:load_few_views"})
register(
    {
        "id": "gridreg-fewview",
        "download_dataset_function": f"{_MODULE}:download_few_views",
        "evaluation_protocol": "nerf",
        "metadata": {
            "id": "gridreg-fewview",
            "name": "Few views",
            "description": "Blender scenes in four to twelve images, under the protocols of few-view papers.",
            "metrics": ["psnr", "ssim", "lpips_vgg"],
            "default_metric": "psnr",
        },
    }
)
