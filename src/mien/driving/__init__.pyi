from .transfer import drive as drive
